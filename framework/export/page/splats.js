// Gaussians drawn by WebGL 2 as framework/kernels/splats/project.py and splat_blend.py draw them: a quadrilateral each,
// from back to front, over the background. An instance is a batch of quadrilaterals: one alone would leave most of a
// GPU idle, and costs a call of its own where WebGL runs in software.

const BATCH = 4096; // Gaussians an instance, and places in a row of the texture of their order
const ROW_OF_TABLE = 1024; // Gaussians in a row of the texture of their table
const HEADER = 16; // bytes of an SPZ file of version 2 (framework/splats/spz.py), before one array an attribute
const TEXEL = 16; // bytes

/** Return the scene of a page: how many `things` it shows, `follow` and `drawer`. Gaussians are sorted by a worker, or
 * `here`. A page of levels contains its coarsest level, and loads others (levels.js). */
function sceneOf(raw, facts, here) {
  const gaussians = gaussiansOf(raw);
  if (facts.levels) return levelsOf(gaussians, facts, here);
  const store = storeOf(facts, gaussians.degree, gaussians.rows, here);
  store.add(0, gaussians, 0);
  store.show([0]);
  return { things: "Gaussians", ...store, count: gaussians.count };
}

/** Return a store of Gaussians of a degree, in chunks that take `rows` rows of a table for the GPU.
 *
 *     add(id, gaussians, row)   adds a chunk, from a row on
 *     remove(id)                removes a chunk that is not `used`
 *     show(ids)                 chooses the chunks that are drawn
 *     used(id)                  whether a chunk is drawn, or may be until the next order comes
 *     follow(view, changed)     has them sorted for a view; true if there is an order to draw in. `changed` is called at
 *                               each new one
 */
function storeOf(facts, degree, rows, here) {
  const chunks = new Map(), sort = sortingElsewhere(here);
  const sorted = { order: null, times: 0 }, store = { degree, rows, chunks, sorted, ids: [] };
  let wanted = null, sorting = false, pending = [], ordered = [];
  return {
    add(id, gaussians, row) {
      if (gaussians.degree !== degree) throw new Refused("The parts of this page do not fit together. Export the page again.");
      chunks.set(id, { gaussians, row });
      sort.add(id, gaussians.centers, ROW_OF_TABLE * row);
    },
    remove(id) {
      chunks.delete(id);
      sort.remove(id);
    },
    show(ids) {
      if (ids.length === store.ids.length && ids.every((id, k) => id === store.ids[k])) return;
      store.ids = ids;
      wanted = null;
    },
    used: (id) => [store.ids, pending, ordered].some((ids) => ids.includes(id)),
    follow(view, changed) {
      const from = { eye: view.eye, axis: facts.look.sort === "depth" ? axesOf(view).forward : null };
      const numbers = [...from.eye, ...(from.axis || [])];
      if (!sorting && !(wanted && wanted.every((x, k) => x === numbers[k]))) {
        sorting = true;
        wanted = numbers;
        pending = store.ids;
        sort.sort({ ...from, ids: pending }, (order) => {
          sorted.order = order;
          sorted.times += 1;
          sorting = false;
          ordered = pending;
          changed();
        });
      }
      return sorted.order !== null;
    },
    drawer: (gl) => drawer(gl, store, facts),
  };
}

/** Return the number of texels of a Gaussian with harmonics up to a degree. */
const texelsOf = (degree) => 2 + Math.ceil((3 * ((degree + 1) ** 2 - 1)) / TEXEL);

/** Return the Gaussians of an unpacked SPZ file: centres (N x 3, scene coordinates), and a table for the GPU.
 *
 * The table has 2 texels of four 32-bit words a Gaussian, and more for its harmonics, with unchanged bytes:
 *     x, y, z as float32; colour and opacity, 8 bits each
 *     three scales, 8 bits each; three components of the quaternion, 8 bits each; two words of 0
 */
function gaussiansOf(raw) {
  const view = new DataView(raw.buffer, raw.byteOffset, raw.byteLength);
  const refuse = (why) => { throw new Refused(`The data in this page are damaged: ${why}. Export the page again.`); };
  if (raw.length < HEADER || view.getUint32(0, true) !== 0x5053474e) refuse("they are not an SPZ file");
  const count = view.getUint32(8, true), degree = raw[12], scale = 2 ** -raw[13];
  if (view.getUint32(4, true) !== 2 || degree > 3 || raw[13] > 30) refuse("their header is not one of ours");
  const rest = 3 * ((degree + 1) ** 2 - 1);
  if (raw.length !== HEADER + count * (19 + rest)) refuse("they are not as long as their header says");
  const texels = texelsOf(degree);
  const positions = HEADER, alphas = positions + 9 * count, colors = alphas + count, scales = colors + 3 * count;
  const turns = scales + 3 * count, harmonics = turns + 3 * count;
  const width = ROW_OF_TABLE * texels, rows = Math.max(Math.ceil(count / ROW_OF_TABLE), 1);
  const table = new Uint8Array(rows * width * TEXEL), centers = new Float32Array(3 * count);
  const floats = new Float32Array(table.buffer);
  for (let i = 0; i < count; i++) {
    const to = i * texels * TEXEL;
    for (let k = 0; k < 3; k++) {
      const from = positions + 9 * i + 3 * k;
      const fixed = ((raw[from] | (raw[from + 1] << 8) | (raw[from + 2] << 16)) << 8) >> 8;
      // SPZ's y and z point the other way.
      floats[to / 4 + k] = centers[3 * i + k] = (k ? -fixed : fixed) * scale;
      table[to + 12 + k] = raw[colors + 3 * i + k];
      table[to + 16 + k] = raw[scales + 3 * i + k];
      table[to + 20 + k] = raw[turns + 3 * i + k];
    }
    table[to + 15] = raw[alphas + i];
    for (let k = 0, from = harmonics + rest * i; k < rest; k++) table[to + 2 * TEXEL + k] = raw[from + k];
  }
  return { count, degree, centers, table: new Uint32Array(table.buffer), rows, texels };
}

/** Return the vertex shader for harmonics up to a degree. */
function vertexShader(degree) {
  const terms = (degree + 1) ** 2 - 1, extra = Math.ceil((3 * terms) / 16);
  let sum = "";
  for (let i = 0; i < extra; i++) sum += `  uvec4 t${i} = texelFetch(table, at + ivec2(${2 + i}, 0), 0);\n`;
  for (let k = 0; k < terms; k++) {
    const value = [0, 1, 2].map((c) => byteOf(3 * k + c)).join(", ");
    sum += `  rgb += (vec3(${value}) / 128.0 - 1.0) * (${HARMONICS[k]});\n`;
  }
  return `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D table;
uniform mat3 turn;       // from the scene to the camera: x right, y down, z forward
uniform vec3 eye;
uniform vec2 focal, center, size;  // pixels
uniform float near, blur;
uniform bool antialiased;
uniform usampler2D order; // from far to near
uniform uint count;
flat out vec4 color;
flat out float cut;
out vec2 corner;

vec3 bytes(uint word) { return vec3(word & 255u, (word >> 8) & 255u, (word >> 16) & 255u); }

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside: not drawn
  uint rank = uint(gl_InstanceID) * ${BATCH}u + (uint(gl_VertexID) >> 2);
  if (rank >= count) return;
  uint which = texelFetch(order, ivec2(rank % ${BATCH}u, rank / ${BATCH}u), 0).r;
  ivec2 at = ivec2(int(which % ${ROW_OF_TABLE}u) * ${texelsOf(degree)}, int(which / ${ROW_OF_TABLE}u));
  uvec4 first = texelFetch(table, at, 0);
  vec3 mean = uintBitsToFloat(first.xyz), p = turn * (mean - eye);
  if (p.z <= near) return;
  float opacity = clamp(float(first.w >> 24), 0.25, 254.75) / 255.0;
  uvec4 second = texelFetch(table, at + ivec2(1, 0), 0);
  vec3 scales = exp(bytes(second.x) / 16.0 - 10.0);
  vec3 v = (bytes(second.y) / 127.5 - 1.0) * vec3(1.0, -1.0, -1.0);
  float w = sqrt(max(1.0 - dot(v, v), 0.0));
  // A quaternion of 8 bits may be longer than 1.
  float inverse = inversesqrt(dot(v, v) + w * w);
  v *= inverse;
  w *= inverse;
  mat3 axes = mat3(  // columns
    1.0 - 2.0 * (v.y * v.y + v.z * v.z), 2.0 * (v.x * v.y + w * v.z), 2.0 * (v.x * v.z - w * v.y),
    2.0 * (v.x * v.y - w * v.z), 1.0 - 2.0 * (v.x * v.x + v.z * v.z), 2.0 * (v.y * v.z + w * v.x),
    2.0 * (v.x * v.z + w * v.y), 2.0 * (v.y * v.z - w * v.x), 1.0 - 2.0 * (v.x * v.x + v.y * v.y));
  vec2 place = p.xy / p.z;
  vec2 low = (-0.15 * size - center) / focal, high = (1.15 * size - center) / focal;
  vec2 held = clamp(place, low, high);
  mat3 seen = turn * axes;
  seen[0] *= scales.x;
  seen[1] *= scales.y;
  seen[2] *= scales.z;
  // Rows of J W R diag(s).
  vec3 row_z = vec3(seen[0].z, seen[1].z, seen[2].z);
  vec3 row_x = focal.x / p.z * (vec3(seen[0].x, seen[1].x, seen[2].x) - held.x * row_z);
  vec3 row_y = focal.y / p.z * (vec3(seen[0].y, seen[1].y, seen[2].y) - held.y * row_z);
  vec3 across = cross(row_x, row_y);
  float spread_x = dot(row_x, row_x), spread_y = dot(row_y, row_y), b = dot(row_x, row_y);
  float plain = dot(across, across), det = plain + blur * (spread_x + spread_y) + blur * blur;
  if (antialiased) opacity *= sqrt(max(plain / det, 1e-30));
  cut = log(opacity * 255.0);
  if (!(cut > 0.0)) return;
  float a = spread_x + blur, c = spread_y + blur;
  vec2 pixel = focal * place + center, reach = sqrt(2.0 * cut * vec2(a, c));
  if (any(lessThan(pixel + reach, vec2(0.0))) || any(greaterThan(pixel - reach, size))) return;
  // The axes of the ellipse on the image.
  float middle = 0.5 * (a + c), radius = length(vec2(0.5 * (a - c), b));
  float long_ = middle + radius, short_ = det / long_;
  vec2 axis = a > c ? vec2(long_ - c, b) : vec2(b, long_ - a);
  axis = radius > 1e-6 * middle ? normalize(axis) : vec2(1.0, 0.0);

  vec3 rgb = 0.5 + ${0.28209479177387814 / 0.15} * (bytes(first.w) / 255.0 - 0.5);
  vec3 d = normalize(mean - eye) * vec3(1.0, -1.0, -1.0);
${sum}  color = vec4(max(rgb, 0.0), opacity);
  corner = vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID & 2) - 1);
  vec2 offset = sqrt(2.0 * cut) * (corner.x * sqrt(long_) * axis + corner.y * sqrt(short_) * vec2(-axis.y, axis.x));
  vec2 clip = 2.0 * (pixel + offset) / size - 1.0;
  gl_Position = vec4(clip.x, -clip.y, 0.0, 1.0);
}`;
}

const FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 color;
flat in float cut;
in vec2 corner;
out vec4 drawn;
void main() {
  float square = dot(corner, corner);
  if (square > 1.0) discard;  // alpha is below 1/255
  float alpha = min(color.a * exp(-cut * square), 0.999);
  drawn = vec4(color.rgb * alpha, alpha);
}`;

const COPY = `#version 300 es
precision highp float;
uniform sampler2D image;
out vec4 drawn;
void main() { drawn = vec4(clamp(texelFetch(image, ivec2(gl_FragCoord.xy), 0).rgb, 0.0, 1.0), 1.0); }`;

/** Return functions that draw the chunks of a store on a canvas, in the order that it holds, and that find surfaces.
 *
 * Colours are summed in 16-bit floats where the browser can: in 8 bits each of a hundred layers would be rounded.
 */
function drawer(gl, store, facts) {
  const { look, near } = facts, { degree, rows: tableRows, chunks, sorted } = store, held = new Map();
  const splat = program(gl, vertexShader(degree), FRAGMENT), copy = program(gl, WHOLE, COPY);
  const most = gl.getParameter(gl.MAX_TEXTURE_SIZE), tableWidth = ROW_OF_TABLE * texelsOf(degree);
  if (tableWidth > most || tableRows > most) {
    throw new Refused("This device's graphics cannot hold this many Gaussians; export with a lower --max-megabytes.");
  }
  texture(gl, gl.TEXTURE0, gl.RGBA32UI, tableWidth, tableRows);
  texture(gl, gl.TEXTURE2, gl.R32UI, BATCH, Math.max(Math.ceil((ROW_OF_TABLE * tableRows) / BATCH), 1));
  /** Give the GPU the chunks that it does not have yet. */
  const holdChunks = () => {
    for (const [id, { gaussians, row }] of chunks) {
      if (held.get(id) === gaussians) continue;
      held.set(id, gaussians);
      gl.activeTexture(gl.TEXTURE0);
      gl.texSubImage2D(
        gl.TEXTURE_2D, 0, 0, row, tableWidth, gaussians.rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, gaussians.table);
    }
    for (const id of held.keys()) if (!chunks.has(id)) held.delete(id);
  };

  const whole = gl.createVertexArray(), each = gl.createVertexArray();
  gl.bindVertexArray(each);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  const corners = Uint16Array.from({ length: 6 * BATCH }, (_, i) => 4 * Math.floor(i / 6) + [0, 1, 2, 2, 1, 3][i % 6]);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  let drawn = 0;

  const halves = gl.getExtension("EXT_color_buffer_half_float") || gl.getExtension("EXT_color_buffer_float");
  const buffer = halves && gl.createFramebuffer();
  let image = null, imageSize = "";
  const target = (width, height) => {
    if (!buffer) return null;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    if (imageSize === `${width} ${height}`) return buffer;
    imageSize = `${width} ${height}`;
    gl.deleteTexture(image);
    image = gl.createTexture();
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, image);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
    return buffer;
  };

  let times = 0;
  const holdOrder = () => {
    const { order } = sorted;
    if (times === sorted.times) return;
    times = sorted.times;
    drawn = order.length;
    const rows = Math.floor(drawn / BATCH), rest = drawn % BATCH;
    gl.activeTexture(gl.TEXTURE2);
    const upload = (row, width, height, part) => gl.texSubImage2D(
      gl.TEXTURE_2D, 0, 0, row, width, height, gl.RED_INTEGER, gl.UNSIGNED_INT, part);
    if (rows) upload(0, BATCH, rows, order.subarray(0, rows * BATCH));
    if (rest) upload(rows, rest, 1, order.subarray(rows * BATCH));
  };

  return {
    draw(camera, background) {
      holdChunks();
      holdOrder();
      const { width, height } = gl.canvas, { made, uniforms } = splat, first = target(width, height);
      gl.viewport(0, 0, width, height);
      gl.clearColor(...background, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.useProgram(made);
      gl.bindVertexArray(each);
      gl.uniform1i(uniforms.table, 0);
      gl.uniform1i(uniforms.order, 2);
      gl.uniform1ui(uniforms.count, drawn);
      gl.uniformMatrix3fv(uniforms.turn, true, camera.turn);
      gl.uniform3fv(uniforms.eye, camera.eye);
      gl.uniform2f(uniforms.focal, camera.fx, camera.fy);
      gl.uniform2f(uniforms.center, camera.cx, camera.cy);
      gl.uniform2f(uniforms.size, width, height);
      gl.uniform1f(uniforms.near, near);
      gl.uniform1f(uniforms.blur, look.blur);
      gl.uniform1i(uniforms.antialiased, look.antialiased ? 1 : 0);
      gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(drawn / BATCH));
      if (!first) return;
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.disable(gl.BLEND);
      gl.useProgram(copy.made);
      gl.bindVertexArray(whole);
      gl.uniform1i(copy.uniforms.image, 1);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    },
    surfaceAt: (...where) => surfaceAt(store.ids.map((id) => chunks.get(id).gaussians), facts, ...where),
  };
}

/** Return a sorter of chunks of Gaussians: from far to near, by radix on the bits of their squared distances, or of their
 * depths along an axis where one is given. Its order has the places of Gaussians in the table. */
function sorter() {
  const chunks = new Map(), counts = new Uint32Array(65536);
  let keys = new Float32Array(0), bits, order, between, places;
  return {
    add(id, centers, first) { chunks.set(id, { centers, first }); },
    remove(id) { chunks.delete(id); },
    sort({ eye: [x, y, z], axis, ids }) {
      const shown = ids.map((id) => chunks.get(id));
      const count = shown.reduce((sum, { centers }) => sum + centers.length / 3, 0);
      if (count > keys.length) {
        keys = new Float32Array(count);
        bits = new Uint32Array(keys.buffer);
        [order, between, places] = [0, 1, 2].map(() => new Uint32Array(count));
      }
      let filled = 0;
      for (const { centers, first } of shown) {
        for (let k = 0; k < centers.length; k += 3, filled++) {
          const a = centers[k] - x, b = centers[k + 1] - y, c = centers[k + 2] - z;
          keys[filled] = axis ? Math.max(a * axis[0] + b * axis[1] + c * axis[2], 0) : a * a + b * b + c * c;
          places[filled] = first + k / 3;
        }
      }
      for (const shift of [0, 16]) {
        counts.fill(0);
        for (let i = 0; i < count; i++) counts[(bits[i] >>> shift) & 65535]++;
        for (let value = 65535, start = 0; value >= 0; value--) {
          const number = counts[value];
          counts[value] = start;
          start += number;
        }
        for (let i = 0; i < count; i++) {
          const which = shift ? between[i] : i;
          (shift ? order : between)[counts[(bits[which] >>> shift) & 65535]++] = shift ? places[which] : which;
        }
      }
      return order ? order.subarray(0, count) : new Uint32Array(0);
    },
  };
}

/** Return a sorter that works in a worker. Its `sort` takes a function that receives the order; in the page itself
 * where workers are refused. */
function sortingElsewhere(here) {
  const chunks = new Map();
  let worker = null, waiting = null, local = null;
  const inPage = () => {
    if (!local) {
      local = sorter();
      for (const [id, [centers, first]] of chunks) local.add(id, centers, first);
    }
    return local;
  };
  const refused = () => {
    worker = null;
    if (!waiting) return;
    const [from, done] = waiting;
    waiting = null;
    done(inPage().sort(from));
  };
  const source = `${sorter}
const held = sorter();
onmessage = ({ data: { add, remove, sort } }) => {
  if (add) held.add(...add);
  if (remove !== undefined) held.remove(remove);
  if (!sort) return;
  const order = held.sort(sort).slice();
  postMessage(order, [order.buffer]);
};`;
  if (!here && typeof Worker === "function") {
    try {
      worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
      worker.onerror = (event) => { event.preventDefault(); refused(); };
      worker.onmessage = ({ data }) => {
        const [, done] = waiting;
        waiting = null;
        done(data);
      };
    } catch (error) {
      refused();
    }
  }
  return {
    add(id, centers, first) {
      chunks.set(id, [centers, first]);
      if (worker) worker.postMessage({ add: [id, centers, first] });
      else if (local) local.add(id, centers, first);
    },
    remove(id) {
      chunks.delete(id);
      if (worker) worker.postMessage({ remove: id });
      else if (local) local.remove(id);
    },
    sort(from, done) {
      if (!worker) { done(inPage().sort(from)); return; }
      waiting = [from, done];
      worker.postMessage({ sort: from });
    },
  };
}

/** Return the surface at a position of a picture, or null: at the Gaussian that makes the ray half opaque. */
function surfaceAt(chunks, { look, near }, view, width, height, x, y) {
  const camera = cameraOf(view, width, height), { right, down, forward } = axesOf(view);
  const byte = (word, k) => (word >>> (8 * k)) & 255, crossed = [];
  const low = [(-0.15 * width - camera.cx) / camera.fx, (-0.15 * height - camera.cy) / camera.fy];
  const high = [(1.15 * width - camera.cx) / camera.fx, (1.15 * height - camera.cy) / camera.fy];
  for (const { count, texels, centers, table: bytes } of chunks) for (let i = 0; i < count; i++) {
    const at = 4 * texels * i, mean = [0, 1, 2].map((k) => centers[3 * i + k] - view.eye[k]);
    const z = dot(mean, forward);
    if (z <= near) continue;
    const place = [dot(mean, right) / z, dot(mean, down) / z], scales = [0, 1, 2].map((k) => Math.exp(byte(bytes[at + 4], k) / 16 - 10));
    const dx = x - camera.fx * place[0] - camera.cx, dy = y - camera.fy * place[1] - camera.cy;
    const held = place.map((value, k) => Math.min(Math.max(value, low[k]), high[k]));
    const stretch = 1 + Math.hypot(...held), focal = Math.max(camera.fx, camera.fy) / z;
    const reach = 3.4 * Math.hypot(focal * stretch * Math.max(...scales), Math.sqrt(look.blur)); // sqrt(2 log 255) is 3.33
    if (Math.abs(dx) > reach || Math.abs(dy) > reach) continue;
    // The rows of J W R diag(s), as in the vertex shader.
    const v = [0, 1, 2].map((k) => (byte(bytes[at + 5], k) / 127.5 - 1) * (k ? -1 : 1));
    const w = Math.sqrt(Math.max(1 - dot(v, v), 0)), norm = 1 / Math.hypot(...v, w);
    const [a, b, c, d] = [...v, w].map((value) => value * norm);
    const columns = [
      [1 - 2 * (b * b + c * c), 2 * (a * b + d * c), 2 * (a * c - d * b)],
      [2 * (a * b - d * c), 1 - 2 * (a * a + c * c), 2 * (b * c + d * a)],
      [2 * (a * c + d * b), 2 * (b * c - d * a), 1 - 2 * (a * a + b * b)],
    ];
    const seen = (axis) => columns.map((column, k) => dot(axis, column) * scales[k]), rowZ = seen(forward);
    const rowX = seen(right).map((value, k) => (camera.fx / z) * (value - held[0] * rowZ[k]));
    const rowY = seen(down).map((value, k) => (camera.fy / z) * (value - held[1] * rowZ[k]));
    const flat = Math.hypot(...cross(rowX, rowY)) ** 2, xy = dot(rowX, rowY);
    const xx = dot(rowX, rowX) + look.blur, yy = dot(rowY, rowY) + look.blur;
    const det = flat + look.blur * (xx + yy) - look.blur * look.blur;
    let opacity = Math.min(Math.max(bytes[at + 3] >>> 24, 0.25), 254.75) / 255;
    if (look.antialiased) opacity *= Math.sqrt(Math.max(flat / det, 1e-30));
    const exponent = (0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy)) / det;
    if (exponent >= Math.log(opacity * 255)) continue;
    const alpha = Math.min(opacity * Math.exp(-exponent), 0.999), distance = Math.hypot(...mean);
    crossed.push({ alpha, distance, order: look.sort === "depth" ? z : distance });
  }
  crossed.sort((one, other) => one.order - other.order);
  let through = 1;
  const hit = crossed.find(({ alpha }) => { through *= 1 - alpha; return through <= 0.5; });
  if (!hit) return null;
  const ray = add(add(forward, right, (x - camera.cx) / camera.fx), down, (y - camera.cy) / camera.fy);
  return add(view.eye, ray, hit.distance / Math.hypot(...ray));
}
