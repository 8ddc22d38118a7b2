// Gaussians drawn by WebGL 2 as framework/kernels/splats/project.py and splat_blend.py draw them: a quadrilateral each,
// from back to front, over the background. An instance is a batch of quadrilaterals: one alone would leave most of a
// GPU idle, and costs a call of its own where WebGL runs in software.

const BATCH = 4096; // Gaussians an instance, and places in a row of the texture of their order

const HARMONICS = [
  "-0.4886025119029199 * d.y", "0.4886025119029199 * d.z", "-0.4886025119029199 * d.x",
  "1.0925484305920792 * d.x * d.y", "-1.0925484305920792 * d.y * d.z",
  "0.31539156525252005 * (3.0 * d.z * d.z - 1.0)", "-1.0925484305920792 * d.x * d.z",
  "0.5462742152960396 * (d.x * d.x - d.y * d.y)",
  "-0.5900435899266435 * d.y * (3.0 * d.x * d.x - d.y * d.y)", "2.890611442640554 * d.x * d.y * d.z",
  "-0.4570457994644658 * d.y * (5.0 * d.z * d.z - 1.0)", "0.3731763325901154 * d.z * (5.0 * d.z * d.z - 3.0)",
  "-0.4570457994644658 * d.x * (5.0 * d.z * d.z - 1.0)", "1.445305721320277 * d.z * (d.x * d.x - d.y * d.y)",
  "-0.5900435899266435 * d.x * (d.x * d.x - 3.0 * d.y * d.y)",
];

/** Return the vertex shader for harmonics up to a degree. */
function vertexShader(degree) {
  const byte = (i) => `float((t${i >> 4}[${(i >> 2) & 3}] >> ${8 * (i & 3)}u) & 255u)`;
  const terms = (degree + 1) ** 2 - 1, extra = Math.ceil((3 * terms) / 16);
  let sum = "";
  for (let i = 0; i < extra; i++) sum += `  uvec4 t${i} = texelFetch(table, at + ivec2(${2 + i}, 0), 0);\n`;
  for (let k = 0; k < terms; k++) {
    const value = [0, 1, 2].map((c) => byte(3 * k + c)).join(", ");
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
  ivec2 at = ivec2(int(which & 1023u) * ${2 + extra}, int(which >> 10));
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

const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2((gl_VertexID & 1) * 4 - 1, (gl_VertexID >> 1) * 4 - 1), 0.0, 1.0); }`;

const COPY = `#version 300 es
precision highp float;
uniform sampler2D image;
out vec4 drawn;
void main() { drawn = vec4(clamp(texelFetch(image, ivec2(gl_FragCoord.xy), 0).rgb, 0.0, 1.0), 1.0); }`;

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Refused(`This browser's graphics cannot draw the page: ${gl.getProgramInfoLog(made) || "no reason given"}`);
  }
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(made, i);
    uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { made, uniforms };
}

/** Return functions that draw Gaussians on a canvas: `setOrder(order)`, `draw(camera, background)`.
 *
 * Colours are summed in 16-bit floats where the browser can: in 8 bits each of a hundred layers would be rounded.
 */
function drawer(gl, gaussians, { look, near }) {
  const splat = program(gl, vertexShader(gaussians.degree), FRAGMENT), copy = program(gl, WHOLE, COPY);
  const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  if (gaussians.width > most || gaussians.rows > most) {
    throw new Refused("This device's graphics cannot hold this many Gaussians; export with a lower --max-megabytes.");
  }
  const texture = (unit, format, width, height) => {
    gl.activeTexture(unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  };
  const { width: tableWidth, rows: tableRows } = gaussians;
  texture(gl.TEXTURE0, gl.RGBA32UI, tableWidth, tableRows);
  gl.texSubImage2D(
    gl.TEXTURE_2D, 0, 0, 0, tableWidth, tableRows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, gaussians.table);
  texture(gl.TEXTURE2, gl.R32UI, BATCH, Math.max(Math.ceil(gaussians.count / BATCH), 1));

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

  return {
    setOrder(order) {
      drawn = order.length;
      const rows = Math.floor(drawn / BATCH), rest = drawn % BATCH;
      gl.activeTexture(gl.TEXTURE2);
      const upload = (row, width, height, part) => gl.texSubImage2D(
        gl.TEXTURE_2D, 0, 0, row, width, height, gl.RED_INTEGER, gl.UNSIGNED_INT, part);
      if (rows) upload(0, BATCH, rows, order.subarray(0, rows * BATCH));
      if (rest) upload(rows, rest, 1, order.subarray(rows * BATCH));
    },
    draw(camera, background) {
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
  };
}

/** Return a function that sorts Gaussians from far to near, by radix on the bits of their squared distances, or of their
 * depths along an axis where one is given. */
function sorter(centers) {
  const count = centers.length / 3;
  const keys = new Float32Array(count), bits = new Uint32Array(keys.buffer), counts = new Uint32Array(65536);
  const order = new Uint32Array(count), between = new Uint32Array(count);
  return ({ eye: [x, y, z], axis }) => {
    for (let i = 0, k = 0; i < count; i++, k += 3) {
      const a = centers[k] - x, b = centers[k + 1] - y, c = centers[k + 2] - z;
      keys[i] = axis ? Math.max(a * axis[0] + b * axis[1] + c * axis[2], 0) : a * a + b * b + c * c;
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
        (shift ? order : between)[counts[(bits[which] >>> shift) & 65535]++] = which;
      }
    }
    return order;
  };
}

/** Return a function ({ eye, axis }, done) that sorts in a worker; in the page itself where workers are refused. */
function sortingElsewhere(centers, here) {
  const local = () => {
    const sort = sorter(centers);
    return (from, done) => done(sort(from));
  };
  if (here || typeof Worker !== "function") return local();
  const source = `${sorter}
let sort;
onmessage = ({ data }) => {
  if (data.centers) { sort = sorter(data.centers); return; }
  const order = sort(data).slice();
  postMessage(order, [order.buffer]);
};`;
  let worker, waiting = null, fallback = null;
  const refused = () => {
    worker = null;
    fallback = fallback || local();
    if (waiting) fallback(...waiting);
    waiting = null;
  };
  try {
    worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
    worker.onerror = (event) => { event.preventDefault(); refused(); };
    worker.onmessage = ({ data }) => {
      const [, done] = waiting;
      waiting = null;
      done(data);
    };
    worker.postMessage({ centers });
  } catch (error) {
    refused();
  }
  return (from, done) => {
    if (!worker) { fallback(from, done); return; }
    waiting = [from, done];
    worker.postMessage(from);
  };
}
