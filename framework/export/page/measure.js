// Measuring, as framework/evaluation/measuring.py does it: a length between two points of surfaces, with its error.

const HALF = 0.5; // error of a point in a photograph, pixels
const SEEN_WITHIN = Math.cos(Math.PI / 3); // angle, seen from a point, between the view and the cameras that see it too

/** Return the covariance of a point, six numbers xx xy xz yy yz zz, by the photographs that see it from about where the
 * view is; null if fewer than two do. */
function covarianceAt(cameras, eye, point) {
  const sum = [0, 0, 0, 0, 0, 0], away = add(eye, point, -1);
  let sharpest = 0, count = 0;
  for (const [, pose, [fx, fy, cx, cy, width, height]] of cameras) {
    const column = (k, sign = 1) => [pose[k], pose[4 + k], pose[8 + k]].map((value) => sign * value);
    const right = column(0), down = column(1, -1), forward = column(2, -1), to = add(point, column(3), -1);
    const z = dot(to, forward), x = dot(to, right) / z, y = dot(to, down) / z;
    const u = fx * x + cx, v = fy * y + cy;
    if (z <= 0 || u < 0 || v < 0 || u >= width || v >= height) continue;
    if (-dot(to, away) < SEEN_WITHIN * Math.hypot(...to) * Math.hypot(...away)) continue;
    let square = 0;
    for (const j of [add(right, forward, -x).map((value) => (value * fx) / z), add(down, forward, -y).map((value) => (value * fy) / z)]) {
      [[0, 0], [0, 1], [0, 2], [1, 1], [1, 2], [2, 2]].forEach(([m, n], k) => { sum[k] += (j[m] * j[n]) / (HALF * HALF); });
      square += dot(j, j) / 2;
    }
    sharpest = Math.max(sharpest, Math.sqrt(square));
    count += 1;
  }
  const [xx, xy, xz, yy, yz, zz] = sum;
  const minors = [yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy];
  const det = xx * minors[0] + xy * minors[1] + xz * minors[2];
  if (count < 2 || !(det > 1e-12 * (xx + yy + zz) ** 3)) return null;
  const reading = (HALF / sharpest) ** 2;
  return minors.map((minor, k) => minor / det + (k === 0 || k === 3 || k === 5 ? reading : 0));
}

/** Return the length between two points of a page as text, such as 0.213 m ± 0.001 m. */
function lengthText(facts, [start, end]) {
  const between = add(end.point, start.point, -1), length = Math.hypot(...between), name = facts.unit && ` ${facts.unit}`;
  const known = facts.photographed && facts.relative_error !== null && length > 0;
  const parts = [start, end].map(({ point, eye }) => known && covarianceAt(facts.cameras, eye, point));
  if (!parts.every(Boolean)) return `${(facts.unit_length * length).toPrecision(4)}${name}`;
  const [xx, xy, xz, yy, yz, zz] = parts[0].map((value, k) => value + parts[1][k]), [x, y, z] = between.map((value) => value / length);
  const square = xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z);
  const error = facts.unit_length * Math.hypot(Math.sqrt(square), length * facts.relative_error);
  const digits = Math.min(Math.max(1 - Math.floor(Math.log10(error)), 0), 12);
  return `${(facts.unit_length * length).toFixed(digits)}${name} ± ${error.toFixed(digits)}${name}`;
}

/** Return the measuring tool: `pick` adds a point, and `follow` moves the line with the view. */
function ruler(facts) {
  let points = [], text = "";
  const board = element("ruler"), [line, first, second, label] = board.children;
  const tool = {
    clear() {
      points = [];
      text = "";
      state.measured = "";
    },
    pick(view, point) {
      points = [...(points.length === 1 ? points : []), { point, eye: view.eye }];
      text = points.length === 2 ? lengthText(facts, points) : "";
      state.points = points.map((one) => one.point.map((value) => value.toFixed(5)).join(" ")).join("|");
      state.measured = text;
    },
    follow(view, width, height) {
      const camera = cameraOf(view, width, height), { right, down, forward } = axesOf(view);
      const places = points.map(({ point }) => {
        const to = add(point, view.eye, -1), z = dot(to, forward);
        return z > 0 ? [(camera.fx * dot(to, right)) / z + camera.cx, (camera.fy * dot(to, down)) / z + camera.cy] : null;
      });
      const shown = places.every(Boolean), set = (node, values) => {
        for (const [name, value] of Object.entries(values)) node.setAttribute(name, value);
      };
      [first, second].forEach((node, k) => {
        node.style.display = shown && places[k] ? "" : "none";
        if (places[k]) set(node, { cx: places[k][0], cy: places[k][1] });
      });
      line.style.display = label.style.display = shown && places.length === 2 ? "" : "none";
      if (!shown || places.length < 2) return;
      const [[x1, y1], [x2, y2]] = places;
      set(line, { x1, y1, x2, y2 });
      set(label, { x: (x1 + x2) / 2, y: Math.min(y1, y2) - 14 }); // above both ends
      label.textContent = text;
    },
  };
  tool.clear();
  return tool;
}
