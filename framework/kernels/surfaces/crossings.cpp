// Where rays meet the zero level set of a signed distance: sphere tracing in one call. See crossings.py for the
// reference, which has the same names.
//
// A thread takes a chunk of rays and lets some of them advance together, so that the network is evaluated for many
// positions at a time. When a ray ends, the next of the chunk takes its place. A ray's values do not depend on the
// others', so results do not depend on chunks or threads.
#include "march/waves.h"
#include "surfaces/signed_distance.h"

using namespace surfaces;

namespace {

constexpr int64_t RAYS = 1024;   // of a chunk
constexpr int ACTIVE = 256;      // rays that advance together
constexpr float INF = std::numeric_limits<float>::infinity();

struct Rays {  // and the grid of occupied cells; see march_wave
    const float *origins, *directions, *enter, *leave, *first, *nears, *radii, *box;
    float step;
    marching::Grid cells;

    void position(int64_t r, float t, float* to) const {
        for (int axis = 0; axis < 3; axis++) to[axis] = origins[r * 3 + axis] + t * directions[r * 3 + axis];
    }
};

struct Limits {
    float shortest, safety, exact;
    int refinements;
};

struct Path {
    int64_t ray;
    float t, before, was, least, nearest, outside, inside, value_outside, value_inside;
};

struct Bracket {  // two positions of a ray, outside and inside
    size_t met;
    int64_t ray;
    float low, high, outside, inside;
    int side;
};

struct Met {
    int64_t ray;
    float t, coverage;
};

template <int F>
struct Search {  // of a chunk
    const Rays& rays;
    const SignedDistance& of;
    const Limits& limits;
    std::vector<Met>& met;
    int64_t evaluations = 0;

    Space space;
    std::vector<Bracket> entered;
    std::vector<float> starts, ends;  // of one step
    float positions[ACTIVE * 3], values[ACTIVE];

    Search(const Rays& rays, const SignedDistance& of, const Limits& limits, std::vector<Met>& met)
        : rays(rays), of(of), limits(limits), met(met) {}

    void run(int64_t base, int64_t last) {
        Path paths[ACTIVE];
        int living = 0;
        for (int64_t next = base; next < last || living;) {
            while (living < ACTIVE && next < last) living += begin(next++, paths[living]);
            for (int i = 0; i < living; i++) rays.position(paths[i].ray, paths[i].t, positions + i * 3);
            evaluate(living);
            int on = 0;
            for (int i = 0; i < living; i++)
                if (advance(paths[i], values[i])) paths[on++] = paths[i];
            living = on;
        }
        for (size_t from = 0; from < entered.size(); from += ACTIVE)
            refine(entered.data() + from, int(std::min<size_t>(ACTIVE, entered.size() - from)));
    }

private:
    void evaluate(int count) {
        if (count) of.template reach<F>(positions, count, limits.safety, space, values);
        evaluations += count;
    }

    // The start of the first step in an occupied cell that ends behind t; false if there is none.
    bool next_piece(int64_t r, float t, float& start) {
        if (!(t < rays.leave[r] + rays.step)) return false;
        const marching::Steps steps(rays.first[r], rays.step, 0);
        int32_t k = int32_t(std::max((t - steps.first) * steps.inverse, 0.0f));
        while (k > 0 && steps.start(k) > t) k--;
        while (!(steps.start(k + 1) > t)) k++;
        starts.clear(), ends.clear();
        const marching::Ray ray(rays.origins + r * 3, rays.directions + r * 3, rays.box, rays.cells.resolution);
        if (!march_ray(ray, steps, rays.cells, 1, rays.enter[r], rays.leave[r], 1, k, starts, ends)) return false;
        start = starts[0];
        return true;
    }

    bool begin(int64_t r, Path& path) {
        float start;
        if (!(rays.leave[r] > rays.enter[r]) || !next_piece(r, rays.first[r], start)) return false;
        // The first piece may begin at the face of the box, with the outside behind it, or at the ray's own start.
        const bool clear = start > rays.nears[r] + limits.shortest;
        path = {r, start, start, clear ? 1.0f : -1.0f, clear ? INF : -INF, start, -INF, start, start, start};
        return true;
    }

    // Notes the distance at the ray's position, and moves it on; false if it has ended.
    bool advance(Path& p, float value) {
        const float radius = rays.radii ? rays.radii[p.ray] * p.t : 0;
        const bool was_in = p.outside > -INF, enters = !was_in && p.was > 0 && value <= 0;
        if (value < p.least && (was_in || enters || value > 0)) p.least = value, p.nearest = p.t;
        if (enters) p.outside = p.before, p.inside = p.t, p.value_outside = p.was, p.value_inside = value;
        const bool covered = (p.outside > -INF && p.least <= -radius) || std::isnan(value);  // a broken field shows
        if (covered) {
            note(p, 1);
            return false;
        }
        constexpr float ROUNDING = 4 * std::numeric_limits<float>::epsilon();
        const float step = std::max({std::fabs(value), limits.shortest, radius / 2, ROUNDING * p.t}), to = p.t + step;
        float start = 0;
        const bool over = !next_piece(p.ray, to, start), gap = !over && start > to + limits.shortest;
        const bool clear = value > radius || over || gap;
        if (clear && p.least < radius && p.least > -INF) note(p, std::min(1.0f, 0.5f - 0.5f * p.least / radius));
        if (over) return false;
        p.before = gap ? start : p.t, p.was = gap ? 1 : value, p.t = std::max(to, start);
        if (clear) p.least = INF, p.outside = -INF;
        return true;
    }

    void note(const Path& p, float coverage) {
        if (p.outside > -INF)
            entered.push_back({met.size(), p.ray, p.outside, p.inside, p.value_outside, p.value_inside, 0});
        met.push_back({p.ray, p.nearest, coverage});
    }

    // Finds where distances are 0 by regula falsi (Illinois).
    void refine(Bracket* brackets, int left) {
        for (int round = 0; round < limits.refinements && left; round++) {
            for (int i = 0; i < left; i++) {
                const Bracket& b = brackets[i];
                const float t = b.low + (b.high - b.low) * (b.outside / (b.outside - b.inside));
                met[b.met].t = t;
                rays.position(b.ray, t, positions + i * 3);
            }
            evaluate(left);
            int on = 0;
            for (int i = 0; i < left; i++) {
                Bracket b = brackets[i];
                const float value = values[i], t = met[b.met].t;
                const int side = value > 0 ? 1 : -1;
                const float half = side == b.side ? 0.5f : 1;  // an end that stays twice, so that it approaches too
                if (value > 0) b.low = t, b.outside = value, b.inside *= half;
                else b.high = t, b.inside = value, b.outside *= half;
                b.side = side;
                if (std::fabs(value) > limits.exact) brackets[on++] = b;
            }
            left = on;
        }
    }
};

struct Found {  // results that the caller has not taken yet
    std::vector<std::vector<Met>> of_chunks;
    std::vector<int64_t> evaluations;
    int64_t rays = 0, total = -1;
};

Found& found() {
    static thread_local Found of_caller;
    return of_caller;
}

}  // namespace

// The rays and their grid of one box are as in march_begin and march_wave, the distance as in signed_distances.
// nears (R): the rays' own starts; radii (R): of the rays' cones at distance 1, or null for 0. `total`: number of
// crossings, which crossings_take returns.
EXPORT int crossings_find(const float* origins, const float* directions, const float* enter, const float* leave,
                          const float* first_steps, const float* nears, const float* radii, int64_t rays,
                          const float* box, float step, const uint8_t* bits, const uint8_t* blocks, int resolution,
                          float shortest, float safety, float exact, int refinements, const float* shift,
                          const float* table, int features, const int64_t* resolutions, const int64_t* offsets,
                          int levels, const float* first, int hidden, const float* second, int outputs,
                          const float* centre, const float* scale, float size, float radius, float rounding,
                          const float* floor, int threads, int64_t* total) {
    return guarded([&] {
        const int side = (resolution + marching::BLOCK - 1) / marching::BLOCK;
        const Rays through{origins, directions, enter, leave, first_steps, nears, radii, box, step,
                           {bits, blocks, resolution, side}};
        const SignedDistance of{{centre, scale, size, radius, rounding, floor},
                                shift,
                                {table, resolutions, offsets, levels},
                                {levels * features, hidden, outputs, first, second}};
        const Limits limits{shortest, safety, exact, refinements};
        Found& all = found();
        all.total = -1, all.rays = rays;
        const int64_t chunks = (rays + RAYS - 1) / RAYS;
        all.of_chunks.assign(size_t(chunks), {});
        all.evaluations.assign(size_t(chunks), 0);
        for_chunks(threads, chunks, [&](int64_t c, int) {
            const int64_t base = c * RAYS, last = std::min(rays, base + RAYS);
            std::vector<Met>& met = all.of_chunks[size_t(c)];
#define CALL(F)                                                            \
    do {                                                                   \
        const auto search = std::make_unique<Search<F>>(through, of, limits, met); \
        search->run(base, last);                                           \
        all.evaluations[size_t(c)] = search->evaluations;                  \
    } while (0)
            FOR_FEATURES(features, CALL)
#undef CALL
        });
        int64_t sum = 0;
        for (const auto& met : all.of_chunks) sum += int64_t(met.size());
        *total = all.total = sum;
    });
}

// The result of crossings_find, sorted by ray and distance: owners, t and coverage (N). `evaluations`: number of
// evaluations of the distance.
EXPORT int crossings_take(int64_t rays, int64_t total, int64_t* owners, float* t, float* coverage,
                          int64_t* evaluations) {
    return guarded([&] {
        Found& all = found();
        if (all.total != total || all.rays != rays) throw std::invalid_argument("there is no such search");
        int64_t from = 0, sum = 0;
        for (size_t c = 0; c < all.of_chunks.size(); c++) {
            std::vector<Met>& met = all.of_chunks[c];
            // The crossings of a ray are in order.
            std::stable_sort(met.begin(), met.end(), [](const Met& a, const Met& b) { return a.ray < b.ray; });
            for (const Met& each : met) owners[from] = each.ray, t[from] = each.t, coverage[from] = each.coverage, from++;
            sum += all.evaluations[c];
        }
        all.total = -1;
        *evaluations = sum;
    });
}
