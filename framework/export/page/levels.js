// Levels of detail: for a view, the coarsest chunks of Gaussians whose error on the screen is small enough. They are
// loaded from the folder beside the page, coarse ones first. What is not there yet is drawn by a coarser chunk above it.
// A chunk is a node of a tree (framework/levels/nodes.py). Each node follows those below it.

const LEVEL_ERROR = 1; // pixels: largest standard deviation of a merged Gaussian on the screen
const AT_ONCE = 4; // requests
const MOST = { mouse: 1000000, finger: 300000 }; // Gaussians that are drawn, on computers and on phones
const WAIT = 10000; // milliseconds before a chunk that could not be loaded is asked for again
const EVERY = 100; // milliseconds between two choices of chunks while the view moves

/** Return the scene of a page of levels with `first` as its coarsest chunk. */
function levelsOf(first, facts, here) {
  const levels = facts.levels, tree = treeOf(levels), root = tree.count - 1;
  const most = matchMedia("(pointer: coarse)").matches ? MOST.finger : MOST.mouse;
  const rows = Math.ceil(levels.largest / ROW_OF_TABLE), places = Math.max(Math.ceil((3 * most) / (ROW_OF_TABLE * rows)), 4);
  const free = Array.from({ length: places }, (_, k) => k).reverse();
  const store = storeOf(facts, first.degree, places * rows, here);
  const there = new Map(), asked = new Set(), failed = new Map(), seenAt = new Float64Array(tree.count);
  let changed = () => {}, shown = 0, silent = false, chosen = -EVERY, later = 0;

  function keep(node, gaussians) {
    // A chunk of another export would lie over its neighbours in the table.
    if (gaussians.count !== tree.counts[node]) throw new Refused("The parts of this page do not fit together. Export the page again.");
    store.add(node, gaussians, free[free.length - 1] * rows);
    there.set(node, { place: free.pop(), count: gaussians.count });
  }

  /** Make room for a chunk; false if all that is there is needed. */
  function makeRoom(needed) {
    if (free.length > asked.size) return true;
    let oldest = -1;
    for (const node of there.keys()) {
      if (node === root || needed.has(node) || store.used(node)) continue;
      if (oldest < 0 || seenAt[node] < seenAt[oldest]) oldest = node;
    }
    if (oldest < 0) return false;
    free.push(there.get(oldest).place);
    there.delete(oldest);
    store.remove(oldest);
    return true;
  }

  async function load(node) {
    asked.add(node);
    try {
      const response = await fetch(`${encodeURIComponent(levels.folder)}/${levels.chunks[node]}.spz`);
      if (!response.ok) throw new Error(`status ${response.status}`);
      const raw = await gunzip(new Uint8Array(await response.arrayBuffer()), options.get("inflate") === "here");
      keep(node, gaussiansOf(raw));
      failed.delete(node);
    } catch (error) {
      failed.set(node, performance.now());
      setTimeout(() => changed(), WAIT + 100);
      complain(error);
    } finally {
      asked.delete(node);
    }
    changed();
  }

  /** Say once that finer parts cannot be loaded; the coarse ones stay. */
  function complain(error) {
    if (silent) return;
    if (state.state !== "ready") { setTimeout(complain, EVERY, error); return; }
    silent = true;
    const message = element("message");
    const why = `the rest is in the folder “${levels.folder}” beside this page, and could not be loaded. Browsers load it` +
      " from a web server, not from disk; put both on one.";
    message.textContent = `Only a coarse version is shown: ${error instanceof Refused ? error.message : why}`;
    message.hidden = false;
    canvas.addEventListener("pointerdown", () => { message.hidden = true; }, { once: true });
  }

  /** Choose the chunks to draw and to load for a view. */
  function choose(view) {
    const now = performance.now();
    const [width, height] = plain ? view.lens.slice(4)
      : [canvas.clientWidth, canvas.clientHeight].map((side) => side * (window.devicePixelRatio || 1));
    const camera = cameraOf(view, width, height), border = 3.4 * Math.sqrt(facts.look.blur);
    const inView = tree.inView(camera, width, height, border); // sqrt(2 log 255) is 3.33
    const sizes = tree.sizes(camera, facts.near);
    const cut = new Set(cutOf(tree, sizes, inView, LEVEL_ERROR, most, Math.floor(places / 2)));
    const wanted = [], needed = new Set();
    for (let layer = [root]; layer.length;) {
      const next = [];
      for (const node of layer.sort((a, b) => sizes[b] - sizes[a])) {
        needed.add(node);
        seenAt[node] = now;
        if (!there.has(node)) wanted.push(node);
        if (!cut.has(node)) next.push(...tree.children[node].filter((child) => inView[child]));
      }
      layer = next;
    }
    const drawn = coverOf(tree, cut, inView, (node) => there.has(node)) || [root];
    store.show(drawn);
    shown = drawn.reduce((sum, node) => sum + there.get(node).count, 0);
    for (const node of wanted) {
      if (asked.size >= AT_ONCE) break;
      if (!asked.has(node) && !(now - failed.get(node) < WAIT) && makeRoom(needed)) load(node);
    }
    state.missing = wanted.length;
  }

  keep(root, first);
  return {
    get count() { return shown; },
    things: `of ${levels.total.toLocaleString("en")} Gaussians`,
    follow(view, tell) {
      changed = tell;
      const now = performance.now();
      if (now - chosen >= EVERY) {
        chosen = now;
        choose(view);
      } else if (!later) {
        later = setTimeout(() => { later = 0; changed(); }, EVERY);
      }
      return store.follow(view, tell);
    },
    drawer: store.drawer,
  };
}

/** Return the tree of a page: children of each node, and their view by a camera. */
function treeOf({ counts, parents, boxes, reach, errors }) {
  const children = counts.map(() => []);
  parents.forEach((parent, node) => { if (parent >= 0) children[parent].push(node); });
  const corners = boxes.map((box) => [0, 1, 2, 3, 4, 5, 6, 7].map((k) => [0, 1, 2].map((axis) => box[axis + 3 * ((k >> axis) & 1)])));
  return {
    count: counts.length, counts, parents, children,
    /** Return whether an image may show each node or its descendants, with Gaussians up to `border` pixels outside
     * (framework/levels/on_image.py). */
    inView(camera, width, height, border) {
      const [right, down, forward] = [0, 3, 6].map((k) => camera.turn.slice(k, k + 3)), limits = [];
      for (const [axis, focal, middle, size] of [[right, camera.fx, camera.cx, width], [down, camera.fy, camera.cy, height]]) {
        const low = (-border - middle) / focal, high = (size + border - middle) / focal, spare = 0.02 * (high - low);
        limits.push([axis, -1, low - spare], [axis, 1, high + spare]);
      }
      return corners.map((eight, node) => {
        const from = eight.map((corner) => add(corner, camera.eye, -1));
        if (!from.some((to) => dot(to, forward) > 0)) return false;
        // Twice the reach of Gaussians: their extent on the image is stretched away from its middle.
        return limits.every(([axis, side, limit]) => Math.min(
          ...from.map((to) => side * (dot(to, axis) - limit * dot(to, forward)))) <= 2 * Math.hypot(1, limit) * reach[node]);
      });
    },
    /** Return the error of each node in the middle of an image, pixels (framework/levels/on_image.py). */
    sizes(camera, near) {
      const focal = Math.max(camera.fx, camera.fy);
      return boxes.map((box, node) => {
        const gap = [0, 1, 2].map((k) => Math.max(box[k] - camera.eye[k], 0) + Math.max(camera.eye[k] - box[k + 3], 0));
        return (focal * errors[node]) / Math.max(Math.hypot(...gap), near);
      });
    },
  };
}

/** Return the nodes that are drawn for a view, as framework/levels/cut.py does: the coarsest ones of at most the level
 * error, or of the smallest larger one with few enough Gaussians and nodes. */
function cutOf({ counts, parents, children }, sizes, inView, levelError, most, mostNodes) {
  const nodes = counts.map((_, node) => node).filter((node) => inView[node]);
  const lower = (node) => (children[node].length ? sizes[node] : -Infinity);
  const upper = (node) => (parents[node] < 0 ? Infinity : sizes[parents[node]]);
  const begins = [...nodes].sort((a, b) => lower(a) - lower(b)), ends = [...nodes].sort((a, b) => upper(a) - upper(b));
  const errors = [levelError, ...new Set(begins.map(lower).filter((size) => size > levelError))];
  let begun = 0, ended = 0, total = 0, count = 0, error = levelError;
  for (error of errors) {
    for (; begun < begins.length && lower(begins[begun]) <= error; begun++, count++) total += counts[begins[begun]];
    for (; ended < ends.length && upper(ends[ended]) <= error; ended++, count--) total -= counts[ends[ended]];
    if (total <= most && count <= mostNodes) break;
  }
  return nodes.filter((node) => lower(node) <= error && error < upper(node));
}

/** Return nodes that are there and show all of a cut that is in view, by coarser ones where finer ones are missing; null
 * if not even the root is there. */
function coverOf({ count, children }, cut, inView, isThere) {
  const cover = (node) => {
    const own = isThere(node) ? [node] : null;
    if (cut.has(node)) return own;
    const parts = children[node].filter((child) => inView[child]).map(cover);
    return parts.some((part) => part === null) ? own : parts.flat();
  };
  return cover(count - 1);
}
