// Shared by both kinds of scene: harmonics in the language of shaders, programs, and textures of numbers.

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

const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2((gl_VertexID & 1) * 4 - 1, (gl_VertexID >> 1) * 4 - 1), 0.0, 1.0); }`;

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

/** Return the expression for byte `i` of texels t0, t1, ... of four words each. */
const byteOf = (i) => `float((t${i >> 4}[${(i >> 2) & 3}] >> ${8 * (i & 3)}u) & 255u)`;

/** Return a new texture of numbers, which is not filtered, in a unit such as gl.TEXTURE0. */
function texture(gl, unit, format, width, height) {
  const made = gl.createTexture();
  gl.activeTexture(unit);
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return made;
}
