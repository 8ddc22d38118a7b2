// An octree with density and colour in its leaves, traced by WebGL 2: a ray a pixel, or several from afar, from leaf to
// leaf and over the largest known empty block around it. It walks as framework/kernels/octree/walk.h does, and shades as
// trace.cpp; no ray needs a stack.

const ROW = 2048; // texels in a row of a texture; every WebGL 2 has textures this wide
const HEAD = 84; // bytes before the first array
const CODES = 256; // densities
const CELLS_PER_PIXEL = 3, MOST_RAYS = 4; // wider pixels get up to 4 x 4 rays: one would show one of many leaves

/** Return the scene of a page: how many `things` it shows, `follow` and `drawer`. */
function sceneOf(raw, facts) {
  const octree = octreeOf(raw);
  return {
    count: octree.count,
    things: "leaves",
    follow: () => true,
    drawer: (gl) => drawer(gl, octree, facts),
  };
}

/** Return the number of bits of a 32-bit word that are 1. */
function ones(word) {
  let x = word - ((word >>> 1) & 0x55555555);
  x = (x & 0x33333333) + ((x >>> 2) & 0x33333333);
  return Math.imul((x + (x >>> 4)) & 0x0f0f0f0f, 0x01010101) >>> 24;
}

/** Return an octree from a page's data (framework/export/octree_page.py), with the arrays of its textures:
 *
 *     bricks     a word each: its number, or minus the distance to the nearest brick that has leaves, in bricks
 *     octants    four words each, eight to a brick: its leaves in two words, a bit each; its first leaf; 0
 *     leaves     a word each for degree 0, else one, two or four times four: the bytes of the density's code and of the
 *                harmonics' coefficients, red, green and blue of the first, then of the second, and so on
 *     depths     (256) optical depth of a cell's edge, by the density's code
 */
function octreeOf(raw) {
  const refuse = (why) => { throw new Refused(`The data in this page are damaged: ${why}. Export the page again.`); };
  const view = new DataView(raw.buffer, raw.byteOffset, raw.byteLength);
  if (raw.length < HEAD || view.getUint32(0, true) !== 0x3154434f) refuse("they are not an octree");
  const [degree, x, y, z, filled, count] = [4, 8, 12, 16, 20, 24].map((at) => view.getUint32(at, true));
  if (degree > 3) refuse("their header is not one of ours");
  const terms = (degree + 1) ** 2, cells = x * y * z;
  const masks = HEAD + 4 * (CODES + 6 * terms), distances = masks + 64 * filled, codes = distances + cells;
  if (raw.length !== codes + count * (1 + 3 * terms)) refuse("they are not as long as their header says");
  const numbers = (at, many) => Array.from({ length: many }, (_, i) => view.getFloat32(at + 4 * i, true));
  const [origin, [cell, limit], turn] = [numbers(28, 3), numbers(40, 2), numbers(48, 9)];
  // Red, green and blue of each harmonic.
  const mixed = (values) => values.map((_, i) => values[(i % 3) * terms + Math.floor(i / 3)]);
  const scales = mixed(numbers(HEAD + 4 * CODES, 3 * terms)), offsets = mixed(numbers(masks - 12 * terms, 3 * terms));
  const rowsOf = (texels) => Math.max(Math.ceil(texels / ROW), 1);

  const bricks = new Int32Array(ROW * rowsOf(cells));
  let found = 0;
  for (let i = 0; i < cells; i++) bricks[i] = raw[distances + i] ? -raw[distances + i] : found++;
  if (found !== filled) refuse("their bricks are not as many as their header says");

  const octants = new Uint32Array(4 * ROW * rowsOf(8 * filled));
  let first = 0;
  for (let i = 0; i < 8 * filled; i++) {
    const at = masks + 8 * i, low = view.getUint32(at, true), high = view.getUint32(at + 4, true);
    octants.set([low, high, first], 4 * i);
    first += ones(low) + ones(high);
  }
  if (first !== count) refuse("their leaves are not as many as their header says");

  const texels = [1, 1, 2, 4][degree], size = degree ? 16 * texels : 4; // bytes of a leaf
  const leaves = new Uint8Array(size * (ROW / texels) * rowsOf(texels * count));
  for (let i = 0; i < count; i++) leaves[size * i] = raw[codes + i];
  for (let k = 0; k < 3 * terms; k++) {
    const to = 1 + 3 * (k % terms) + Math.floor(k / terms), from = codes + count * (1 + k);
    for (let i = 0; i < count; i++) leaves[size * i + to] = raw[from + i];
  }
  return {
    count, degree, extent: [x, y, z], origin, cell, limit, turn, scales, offsets, texels, bricks, octants,
    leaves: new Uint32Array(leaves.buffer), depths: Float32Array.from(numbers(HEAD, CODES)),
  };
}

/** Return the fragment shader for harmonics of a degree. Lengths are in cells. */
function fragmentShader(degree, texels) {
  const terms = (degree + 1) ** 2, basis = ["0.28209479177387814", ...HARMONICS];
  let constants = "  vec3 base = vec3(0.0);\n", fetches = "", sum = "base";
  for (let k = 0; k < terms; k++) {
    constants += `  float y${k} = ${basis[k]};\n  vec3 h${k} = y${k} * scales[${k}];\n  base += y${k} * offsets[${k}];\n`;
    sum += ` + h${k} * vec3(${[1, 2, 3].map((c) => byteOf(3 * k + c)).join(", ")})`;
  }
  for (let i = 0; i < texels; i++) fetches += `      uvec4 t${i} = texelFetch(leaves, from + ivec2(${i}, 0), 0);\n`;
  const width = ROW / texels; // leaves in a row
  return `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp isampler2D;
precision highp usampler2D;
uniform isampler2D bricks;
uniform usampler2D octants;
uniform usampler2D leaves;
uniform sampler2D depths;
uniform ivec3 extent;              // bricks along each axis
uniform vec3 eye;
uniform mat3 turn;                 // from the camera (x right, y down, z forward) to the octree
uniform vec2 focal, center, size;  // pixels
uniform float near, limit;         // where rays start; the transmittance at which they end
uniform int most;                  // steps of a ray
uniform int many;                  // rays along each side of a pixel
uniform vec3 background;
uniform vec3 scales[${terms}];
uniform vec3 offsets[${terms}];
uniform bool picking;              // the distance to the surface is asked for, not the colour
out vec4 drawn;

int ones(uint word) {
  uint x = word - ((word >> 1u) & 0x55555555u);
  x = (x & 0x33333333u) + ((x >> 2u) & 0x33333333u);
  return int((((x + (x >> 4u)) & 0x0f0f0f0fu) * 0x01010101u) >> 24u);
}

// The light of the ray through a place of the picture, and the distance where it is half opaque, or -1.
vec3 traced(vec2 pixel, out float surface) {
  vec3 d = normalize(turn * vec3((pixel - center) / focal, 1.0));
${constants}
  vec3 along = d + 2e-12 * vec3(lessThan(abs(d), vec3(1e-12)));  // no coordinate is 0
  vec3 per = 1.0 / along;
  ivec3 up = ivec3(greaterThan(along, vec3(0.0)));
  ivec3 last = 8 * extent - 1;
  vec3 one = -eye * per, two = (vec3(last + 1) - eye) * per;
  vec3 enter = min(one, two), leave = max(one, two);
  float t = max(max(enter.x, enter.y), max(enter.z, near));
  float far = min(min(leave.x, leave.y), leave.z);
  ivec3 place = ivec3(clamp(floor(eye + t * along), vec3(0.0), vec3(last)));
  vec3 color = vec3(0.0);
  float through = 1.0;
  surface = -1.0;
  for (int i = 0; i < most && t < far; i++) {
    // The block around the cell: all empty, or a leaf.
    ivec3 brick = place >> 3;
    int where = (brick.x * extent.y + brick.y) * extent.z + brick.z;
    int known = texelFetch(bricks, ivec2(where % ${ROW}, where / ${ROW}), 0).r;
    ivec3 corner = place;
    int edge = 1, leaf = -1;
    if (known < 0) {
      corner = 8 * (brick + (known + 1));
      edge = 8 * (-2 * known - 1);
    } else {
      ivec3 part = (place >> 2) & 1, within = place & 3;
      int slot = 8 * known + part.x + 2 * part.y + 4 * part.z;
      uvec4 octant = texelFetch(octants, ivec2(slot % ${ROW}, slot / ${ROW}), 0);
      int bit = within.x + 4 * within.y + 16 * within.z;
      uint word = bit < 32 ? octant.x : octant.y;
      uint mark = 1u << uint(bit % 32);
      if ((octant.x | octant.y) == 0u) {
        corner = place - within;
        edge = 4;
      } else if ((word & mark) != 0u) {
        leaf = int(octant.z) + ones(word & (mark - 1u));
        if (bit >= 32) leaf += ones(octant.x);
      }
    }
    // To its far side.
    ivec3 sides = corner + edge * up;
    vec3 exits = (vec3(sides) - eye) * per;
    float reach = max(min(min(exits.x, exits.y), min(exits.z, far)), t);  // rounding must not lead back
    if (leaf >= 0) {
      ivec2 from = ivec2((leaf % ${width}) * ${texels}, leaf / ${width});
${fetches}      float depth = texelFetch(depths, ivec2(int(t0[0] & 255u), 0), 0).r * (reach - t);
      float weight = through * (1.0 - exp(-depth));
      color += weight * (${sum});
      if (surface < 0.0 && through - weight <= 0.5) surface = t + (reach - t) * log(2.0 * through) / depth;
      through -= weight;
      if (through < limit) break;
    }
    // The cell behind the side that the ray leaves by; on other axes the cell of the position, in the block.
    vec3 at = clamp(floor(eye + reach * along), vec3(-1.0), vec3(last + 1));
    ivec3 next = clamp(ivec3(at), corner, corner + (edge - 1));
    next += ivec3(lessThanEqual(exits, vec3(reach))) * (sides - 1 + up - next);
    if (any(lessThan(next, ivec3(0))) || any(greaterThan(next, last))) break;
    place = next;
    t = reach;
  }
  return color + through * background;
}

void main() {
  vec2 middle = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  vec3 light = vec3(0.0);
  float surface = -1.0;
  for (int i = 0; i < many * many; i++) {
    light += traced(middle + (vec2(i % many, i / many) + 0.5) / float(many) - 0.5, surface);
  }
  if (picking) {
    uint word = floatBitsToUint(surface);
    drawn = vec4(float(word & 255u), float((word >> 8u) & 255u), float((word >> 16u) & 255u), float(word >> 24u)) / 255.0;
  } else {
    drawn = vec4(clamp(light / float(many * many), 0.0, 1.0), 1.0);
  }
}`;
}

/** Return functions that trace an octree on a canvas, and that find surfaces. */
function drawer(gl, octree, { near }) {
  const { made, uniforms } = program(gl, WHOLE, fragmentShader(octree.degree, octree.texels));
  const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  const hold = (unit, [format, order, kind], words, width, values) => {
    const rows = values.length / (words * width);
    if (rows > most) {
      throw new Refused("This device's graphics cannot hold this many leaves; export with a lower --max-megabytes.");
    }
    texture(gl, unit, format, width, rows);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, rows, order, kind, values);
  };
  const fours = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT], words = [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT];
  hold(gl.TEXTURE0, [gl.R32I, gl.RED_INTEGER, gl.INT], 1, ROW, octree.bricks);
  hold(gl.TEXTURE1, fours, 4, ROW, octree.octants);
  hold(gl.TEXTURE2, octree.degree ? fours : words, octree.degree ? 4 : 1, ROW, octree.leaves);
  hold(gl.TEXTURE3, [gl.R32F, gl.RED, gl.FLOAT], 1, CODES, octree.depths);
  const whole = gl.createVertexArray(), pixel = gl.createFramebuffer();
  const asked = texture(gl, gl.TEXTURE4, gl.RGBA8, 1, 1);
  gl.bindFramebuffer(gl.FRAMEBUFFER, pixel);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, asked, 0);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);

  // A vector of the page in the octree's axes.
  const turned = (v) => [0, 1, 2].map((j) => octree.turn[j] * v[0] + octree.turn[3 + j] * v[1] + octree.turn[6 + j] * v[2]);
  const trace = (camera, background, width, height, picking) => {
    const axes = [0, 3, 6].map((row) => turned(camera.turn.slice(row, row + 3)));
    gl.viewport(0, 0, width, height);
    gl.useProgram(made);
    gl.bindVertexArray(whole);
    ["bricks", "octants", "leaves", "depths"].forEach((name, unit) => gl.uniform1i(uniforms[name], unit));
    gl.uniform3iv(uniforms.extent, octree.extent);
    const eye = turned(camera.eye).map((value, k) => (value - octree.origin[k]) / octree.cell);
    const away = Math.hypot(...eye.map((value, k) => value - 4 * octree.extent[k])) / camera.fx;
    gl.uniform3fv(uniforms.eye, eye);
    gl.uniform1i(uniforms.many, picking ? 1 : Math.min(Math.max(Math.ceil(away / CELLS_PER_PIXEL), 1), MOST_RAYS));
    gl.uniformMatrix3fv(uniforms.turn, false, axes.flat());
    gl.uniform2f(uniforms.focal, camera.fx, camera.fy);
    gl.uniform2f(uniforms.center, camera.cx, camera.cy);
    gl.uniform2f(uniforms.size, width, height);
    gl.uniform1f(uniforms.near, near / octree.cell);
    gl.uniform1f(uniforms.limit, octree.limit);
    gl.uniform1i(uniforms.most, 8 * (octree.extent[0] + octree.extent[1] + octree.extent[2]) + 8);
    gl.uniform3fv(uniforms.background, background);
    gl.uniform3fv(uniforms["scales[0]"], octree.scales);
    gl.uniform3fv(uniforms["offsets[0]"], octree.offsets);
    gl.uniform1i(uniforms.picking, picking ? 1 : 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  };

  return {
    draw(camera, background) {
      trace(camera, background, gl.canvas.width, gl.canvas.height, false);
    },
    /** Return where a ray is half opaque, at a position of a picture; null if it never is. */
    surfaceAt(view, width, height, x, y) {
      const camera = cameraOf(view, width, height), { right, down, forward } = axesOf(view), bytes = new Uint8Array(4);
      gl.bindFramebuffer(gl.FRAMEBUFFER, pixel);
      trace({ ...camera, cx: camera.cx - x + 0.5, cy: camera.cy - y + 0.5 }, [0, 0, 0], 1, 1, true);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      const distance = octree.cell * new DataView(bytes.buffer).getFloat32(0, true);
      if (!(distance > 0)) return null;
      const ray = add(add(forward, right, (x - camera.cx) / camera.fx), down, (y - camera.cy) / camera.fy);
      return add(view.eye, ray, distance / Math.hypot(...ray));
    },
  };
}
