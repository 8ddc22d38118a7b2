// The page: a camera that mouse, fingers and keys move, and the controls around the picture.
//
// In the address, behind a #: camera=N starts at the Nth camera; plain=1 shows nothing but that camera's picture, pixel
// by pixel; spin=1 turns around the scene; quality=full draws every pixel and quality=fast a quarter of them; sort=here
// and inflate=here do without worker and DecompressionStream.
//
// The content of the scene is the matter of splats.js, with levels.js, or octree.js: sceneOf(raw, facts, here) returns
// how many `things` there are, follow(view, changed), true if it can be drawn, and drawer(gl), which has
// draw(camera, background) and surfaceAt(view, width, height, x, y).

const element = (id) => document.getElementById(id);
const canvas = element("canvas"), options = new URLSearchParams(location.hash.slice(1));
const plain = options.get("plain") === "1", state = document.documentElement.dataset;
const BACKGROUNDS = [[0, 0, 0], [0.5, 0.5, 0.5], [1, 1, 1]];
const QUALITIES = ["automatic", "full", "fast"]; // automatic: coarser while it moves on a slow device
const STEEPEST = 1.55; // radians
const SLOW = 50, QUICK = 22; // milliseconds a frame
const SPEED = 0.4; // of turning by itself, radians a second

/** Show why there is no picture. */
function refuse(error) {
  const message = element("message");
  message.textContent = error instanceof Refused ? error.message : `This page cannot be shown: ${error.message || error}`;
  message.className = "error";
  message.hidden = false;
  message.setAttribute("role", "alert");
  state.state = "refused";
  if (!(error instanceof Refused)) console.error(error);
}

// -- where one looks from ---------------------------------------------------------------------------------------

const add = (a, b, times = 1) => [a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** Return the axes right, down and forward of a view; z is up where roll is 0. */
function axesOf({ yaw, pitch, roll }) {
  const forward = [Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw), Math.sin(pitch)];
  const level = [Math.sin(yaw), -Math.cos(yaw), 0], below = cross(forward, level);
  const c = Math.cos(roll), s = Math.sin(roll);
  const right = add(level.map((x) => c * x), below, s);
  return { right, down: cross(forward, right), forward };
}

/** Return the view of a camera of the capture, which turns about the point of its axis that is nearest to `focus`. */
function viewOf([, pose, lens], focus) {
  const column = (k) => [pose[k], pose[4 + k], pose[8 + k]];
  const eye = column(3), right = column(0), forward = column(2).map((x) => -x);
  const flat = Math.hypot(forward[0], forward[1]);
  const yaw = flat > 1e-6 ? Math.atan2(forward[1], forward[0]) : Math.atan2(right[0], -right[1]);
  const view = { eye, yaw, pitch: Math.atan2(forward[2], flat), roll: 0, lens };
  const { right: level, down } = axesOf(view);
  view.roll = Math.atan2(dot(right, down), dot(right, level));
  const away = add(focus, eye, -1), ahead = dot(away, forward), distance = Math.hypot(...away);
  view.distance = Math.max(ahead, 0.25 * distance, 1e-6);
  return view;
}

const turned = (view, dx, dy) => {
  const pitch = Math.min(Math.max(view.pitch - dy, -STEEPEST), STEEPEST);
  return { ...view, yaw: view.yaw - dx, pitch, roll: 0.8 * view.roll };
};

/** Turn a view about the point that it looks at. */
function orbited(view, dx, dy) {
  const pivot = add(view.eye, axesOf(view).forward, view.distance), next = turned(view, dx, dy);
  return { ...next, eye: add(pivot, axesOf(next).forward, -view.distance) };
}

/** Return the angle from the end of an arc of directions around `focus` to a view's eye: positive outside, in radians. */
function beyond({ eye }, [middle, width], focus) {
  const angle = Math.atan2(eye[1] - focus[1], eye[0] - focus[0]) - middle;
  return Math.abs(Math.atan2(Math.sin(angle), Math.cos(angle))) - width / 2;
}

/** Turn a view by itself for some seconds, in the direction `way` of 1 or -1: around, or to and fro over the arc of the
 * photographs, slowly at its ends. Return the view and the direction. */
function spun(view, way, seconds, { arc, focus }) {
  if (!arc) return [orbited(view, SPEED * seconds, 0), way];
  const inside = -beyond(view, arc, focus), share = inside < 0 ? 1 : Math.min(Math.max(inside / 0.4, 0.15), 1);
  const angle = SPEED * share * seconds, next = orbited(view, way * angle, 0), out = beyond(next, arc, focus);
  return out > 0 && out > -inside ? [orbited(view, -way * angle, 0), -way] : [next, way];
}

function zoomed(view, factor) {
  const distance = Math.max(view.distance * factor, 1e-6);
  return { ...view, distance, eye: add(view.eye, axesOf(view).forward, view.distance - distance) };
}

/** Move a view by lengths along its axes. */
function moved(view, x, y, z) {
  const { right, down, forward } = axesOf(view);
  return { ...view, eye: add(add(add(view.eye, right, x), down, y), forward, z) };
}

/** Return the view on an image of a size: all that the camera has seen is on it. */
function cameraOf(view, width, height) {
  const [fx, fy, cx, cy, w, h] = view.lens, scale = Math.min(width / w, height / h), axes = axesOf(view);
  return {
    eye: view.eye, turn: [...axes.right, ...axes.down, ...axes.forward], scale,
    fx: fx * scale, fy: fy * scale, cx: cx * scale + (width - w * scale) / 2, cy: cy * scale + (height - h * scale) / 2,
  };
}

// -- the page ---------------------------------------------------------------------------------------------------

async function main() {
  await new Promise((done) => { setTimeout(done); }); // the page is shown first
  const facts = JSON.parse(element("facts").textContent), data = element("data");
  const raw = await gunzip(bytesOf(data.textContent), options.get("inflate") === "here");
  data.remove();
  const scene = sceneOf(raw, facts, plain || options.get("sort") === "here");
  const settings = { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" };
  const gl = canvas.getContext("webgl2", settings);
  if (!gl) {
    throw new Refused("This page needs WebGL 2, which this browser does not have or has switched off. Any browser since" +
      " 2022 has it; where graphics acceleration is off in the settings, switch it on.");
  }
  show(gl, scene, facts);
}

function show(gl, scene, facts) {
  let drawn = scene.drawer(gl), lost = false, measuring = false;
  const measure = ruler(facts);
  const cameras = facts.cameras, asked = chosen(options.get("camera")), start = asked >= 0 ? asked : facts.start;
  let camera = start, view = viewOf(cameras[start], facts.focus), background = facts.background;
  let spinning = options.get("spin") === "1" && !plain, way = 1, dirty = true;
  let quality = Math.max(QUALITIES.indexOf(options.get("quality")), 0);
  const keys = new Set();

  function chosen(text) {
    const index = text === null || text.trim() === "" ? -1 : Number(text);
    return Number.isInteger(index) && index >= 0 && index < cameras.length ? index : -1;
  }

  // Frames: only where something has changed; coarser while it moves on a slow device.
  let coarse = 1, moving = false, last = 0, drew = false, frames = 0, since = 0, line = "";
  function resize() {
    const ratio = window.devicePixelRatio || 1;
    let width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (plain) [width, height] = view.lens.slice(4);
    const factor = plain ? 1 : [moving ? coarse : 1, 1, 0.5][quality];
    width = Math.max(Math.round(width * factor), 1);
    height = Math.max(Math.round(height * factor), 1);
    if (plain) canvas.style.cssText = `width:${width / ratio}px;height:${height / ratio}px;right:auto;bottom:auto`;
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
  }

  const changed = () => { dirty = true; };

  function frame(now) {
    requestAnimationFrame(frame);
    const seconds = Math.min((now - last) / 1000, 0.1), took = now - last, before = moving;
    last = now;
    moving = fly(seconds) || spinning || pointers.size > 0 || now < settled;
    if (before !== moving) dirty = true;
    if (moving && before && drew) adapt(took);
    drew = false;
    if (lost) return;
    if (dirty && scene.follow(view, changed)) {
      dirty = false;
      resize();
      drawn.draw(cameraOf(view, canvas.width, canvas.height), background);
      measure.follow(view, canvas.clientWidth, canvas.clientHeight);
      frames += 1;
      drew = true;
      if (state.state !== "ready") first();
    }
    if (now - since > 1000 && (!moving || frames > 1 || now - since > 10000)) report(now);
  }

  function adapt(took) {
    if (took > SLOW) coarse = Math.max(coarse * Math.max(Math.sqrt(SLOW / took), 0.5), 0.3);
    else if (took < QUICK && coarse < 1) coarse = Math.min(coarse * 1.05, 1);
  }

  function first() {
    gl.getError(); // waits until it is drawn
    element("message").hidden = true;
    state.state = "ready";
    state.seconds = (performance.now() / 1000).toFixed(2);
    state.count = scene.count;
  }

  function report(now) {
    const rate = (1000 * frames) / (now - since);
    if (frames > 1 && moving) state.rate = rate.toFixed(1);
    const text = `${scene.count.toLocaleString("en")} ${scene.things} · ${frames > 1 && moving ? `${rate.toFixed(rate < 10 ? 1 : 0)} frames/s` : "still"}`;
    if (text !== line) element("line").textContent = line = text;
    frames = 0;
    since = now;
  }

  const look = (next) => {
    view = next;
    state.eye = view.eye.map((x) => x.toFixed(4)).join(" ");
    state.distance = view.distance.toFixed(4);
    dirty = true;
  };

  function jump(index) {
    camera = (index + cameras.length) % cameras.length;
    element("slider").value = camera;
    element("name").textContent = `${camera + 1} of ${cameras.length}: ${cameras[camera][0]}`;
    element("slider").setAttribute("aria-valuetext", cameras[camera][0]);
    state.camera = camera;
    look(viewOf(cameras[camera], facts.focus));
  }

  // Keys that are held: how far one flies in a frame.
  const WAYS = {
    KeyW: [0, 0, 1], ArrowUp: [0, 0, 1], KeyS: [0, 0, -1], ArrowDown: [0, 0, -1], KeyA: [-1, 0, 0], ArrowLeft: [-1, 0, 0],
    KeyD: [1, 0, 0], ArrowRight: [1, 0, 0], KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
  };
  function fly(seconds) {
    const ways = [...keys].filter((key) => WAYS[key]).map((key) => WAYS[key]);
    if (ways.length) {
      const step = 0.6 * seconds * view.distance * (keys.has("ShiftLeft") || keys.has("ShiftRight") ? 3 : 1);
      const sum = ways.reduce((a, b) => add(a, b), [0, 0, 0]);
      look({ ...moved(view, step * sum[0], step * sum[1], step * sum[2]) });
    }
    if (spinning) {
      const [next, onwards] = spun(view, way, seconds, facts);
      way = onwards;
      look(next);
    }
    return ways.length > 0;
  }

  // Pointers: one turns, two move and pinch.
  const pointers = new Map();
  let settled = 0, tapped = { time: 0, x: 0, y: 0 };
  const span = () => {
    const [a, b] = [...pointers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, size: Math.max(Math.hypot(a.x - b.x, a.y - b.y), 1) };
  };
  const pan = (dx, dy) => {
    const [fx, , , , w, h] = view.lens, scale = Math.min(canvas.clientWidth / w, canvas.clientHeight / h);
    const length = view.distance / (fx * scale);
    look(moved(view, -dx * length, -dy * length, 0));
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.focus({ preventScroll: true });
    try { canvas.setPointerCapture(event.pointerId); } catch (error) { /* the pointer is gone already */ }
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    canvas.classList.add("held");
    if (spinning) spin(false);
    const { timeStamp: time, clientX: x, clientY: y } = event;
    const again = time - tapped.time < 350 && Math.hypot(x - tapped.x, y - tapped.y) < 24;
    if (pointers.size === 1 && again && !measuring) centre(x, y);
    tapped = { time, x, y };
  });
  canvas.addEventListener("pointermove", (event) => {
    const held = pointers.get(event.pointerId);
    if (!held) return;
    const before = pointers.size === 2 ? span() : null, dx = event.clientX - held.x, dy = event.clientY - held.y;
    held.x = event.clientX;
    held.y = event.clientY;
    if (before) {
      const now = span();
      pan(now.x - before.x, now.y - before.y);
      look(zoomed(view, before.size / now.size));
    } else if (pointers.size === 1 && (event.buttons & 6 || event.ctrlKey)) {
      pan(dx, dy);
    } else if (pointers.size === 1) {
      const angle = 3.5 / Math.max(Math.min(canvas.clientWidth, canvas.clientHeight), 1);
      look((event.shiftKey ? turned : orbited)(view, dx * angle, dy * angle));
    }
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      if (!pointers.size) canvas.classList.remove("held");
    });
  }
  canvas.addEventListener("pointerup", ({ clientX: x, clientY: y, button }) => {
    if (!measuring || button !== 0 || Math.hypot(x - tapped.x, y - tapped.y) > 4) return;
    const point = surface(x, y);
    if (point) measure.pick(view, point);
    dirty = true;
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1;
    look(zoomed(view, Math.exp(Math.min(Math.max(0.0012 * lines * event.deltaY, -1), 1))));
    settled = performance.now() + 250;
  }, { passive: false });

  /** Return the point of the scene that is seen at a position of the page; null for none. */
  function surface(x, y) {
    const box = canvas.getBoundingClientRect();
    return drawn.surfaceAt(view, box.width, box.height, x - box.left, y - box.top);
  }

  /** Turn about the point seen at a position of the page. */
  function centre(x, y) {
    const point = surface(x, y), { forward } = axesOf(view);
    if (!point) return;
    const distance = dot(add(point, view.eye, -1), forward);
    look({ ...view, distance, eye: add(point, forward, -distance) });
  }

  function spin(on) {
    spinning = on;
    element("spin").setAttribute("aria-pressed", on);
    dirty = true;
  }
  function setMeasuring(on) {
    measuring = on;
    element("measure").setAttribute("aria-pressed", on);
    canvas.classList.toggle("measuring", on);
    measure.clear();
    dirty = true;
  }
  const tilt = motion((dx, dy) => { if (spinning) spin(false); look(orbited(view, dx, dy)); });
  const reset = () => { spin(false); jump(start); };
  const behind = () => {
    const at = BACKGROUNDS.findIndex((color) => color.every((x, k) => x === background[k]));
    background = BACKGROUNDS[(at + 1) % BACKGROUNDS.length];
    dirty = true;
  };
  const draw = (index) => {
    quality = index % QUALITIES.length;
    element("quality").textContent = state.quality = QUALITIES[quality];
    dirty = true;
  };
  const full = () => {
    const root = document.documentElement;
    if (document.fullscreenElement) document.exitFullscreen();
    else if (root.requestFullscreen) root.requestFullscreen().catch(() => {});
  };
  const help = (on = element("help").hidden) => {
    element("help").hidden = !on;
    element("ask").setAttribute("aria-expanded", on);
    (on ? element("close") : canvas).focus({ preventScroll: true }); // its beginning is shown
  };
  const bare = () => document.body.classList.toggle("bare");
  const ACTIONS = {
    KeyR: reset, KeyT: () => spin(!spinning), KeyM: () => setMeasuring(!measuring), KeyB: behind, KeyF: full, KeyH: bare, Escape: () => help(false),
    BracketLeft: () => jump(camera - 1), BracketRight: () => jump(camera + 1),
  };
  window.addEventListener("keydown", (event) => {
    if (event.altKey || event.metaKey || event.ctrlKey) return;
    const inControl = event.target instanceof HTMLInputElement;
    if (inControl && event.code.startsWith("Arrow")) return;
    keys.add(event.code);
    if (event.key === "?") help();
    else if (!event.repeat && ACTIONS[event.code] && (event.code !== "Escape" || !element("help").hidden)) ACTIONS[event.code]();
    if (WAYS[event.code]) event.preventDefault();
  });
  window.addEventListener("keyup", (event) => keys.delete(event.code));
  window.addEventListener("blur", () => keys.clear());
  window.addEventListener("resize", () => { dirty = true; });
  window.addEventListener("hashchange", () => {
    const index = chosen(new URLSearchParams(location.hash.slice(1)).get("camera"));
    if (index >= 0) jump(index);
  });

  const slider = element("slider");
  slider.max = cameras.length - 1;
  slider.addEventListener("input", () => { spin(false); jump(Number(slider.value)); });
  for (const [id, action] of Object.entries({
    previous: () => jump(camera - 1), next: () => jump(camera + 1), reset, spin: () => spin(!spinning),
    measure: () => setMeasuring(!measuring), motion: tilt, behind, full, quality: () => draw(quality + 1),
    ask: () => help(), close: () => help(false),
  })) element(id).addEventListener("click", action);
  if (!hasMotion()) element("motion").hidden = true;
  if (!document.documentElement.requestFullscreen) element("full").hidden = true;
  if (cameras.length < 2) element("cameras").hidden = true;
  if (plain) document.body.classList.add("bare");

  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    lost = true;
    state.state = "lost";
    element("message").textContent = "The graphics were taken away by the system; waiting for them …";
    element("message").hidden = false;
  });
  canvas.addEventListener("webglcontextrestored", () => {
    try {
      drawn = scene.drawer(gl);
      lost = false;
      dirty = true;
    } catch (error) {
      refuse(error);
    }
  });
  jump(start);
  draw(quality);
  spin(spinning);
  requestAnimationFrame(frame);
}

main().catch(refuse);
