// Turning a phone turns the view about the point that it looks at, as if the viewer walked around the scene with it:
// for phones with browsers without augmented reality, since every phone has an orientation sensor.

const UPRIGHT = 1.4; // radians: above it, the direction that a phone looks along has no reliable compass angle

/** Return whether a device may have an orientation sensor that somebody turns: a phone or a tablet. */
const hasMotion = () => typeof DeviceOrientationEvent === "function" && matchMedia("(pointer: coarse)").matches;

/** Return yaw and pitch, radians, of the direction that the back of a phone points to, by its angles in degrees about z
 * (up), x (right) and y (along the screen), in that order (W3C, Device Orientation). */
function aimOf({ alpha, beta, gamma }) {
  const [a, b, c] = [alpha, beta, gamma].map((angle) => ((angle || 0) * Math.PI) / 180);
  const x = -(Math.cos(a) * Math.sin(c) + Math.sin(a) * Math.sin(b) * Math.cos(c));
  const y = -(Math.sin(a) * Math.sin(c) - Math.cos(a) * Math.sin(b) * Math.cos(c));
  return [Math.atan2(y, x), Math.asin(Math.min(Math.max(-Math.cos(b) * Math.cos(c), -1), 1))];
}

/** Return a function that switches it on or off; `turn` is given angles as a drag with a finger gives them. */
function motion(turn) {
  let last = null, on = false;
  const follow = (event) => {
    if (event.beta === null) return; // there is no sensor
    const [yaw, pitch] = aimOf(event);
    if (last) {
      const across = Math.max(Math.abs(pitch), Math.abs(last[1])) > UPRIGHT ? 0 : yaw - last[0];
      turn(-Math.atan2(Math.sin(across), Math.cos(across)), last[1] - pitch);
    }
    last = [yaw, pitch];
  };
  return async () => {
    const ask = DeviceOrientationEvent.requestPermission; // iPhones ask the person
    try {
      if (!on && ask && (await ask.call(DeviceOrientationEvent)) !== "granted") return;
    } catch (error) {
      element("motion").hidden = true; // pages from disk may not ask
      return;
    }
    on = !on;
    last = null;
    element("motion").setAttribute("aria-pressed", on);
    window[on ? "addEventListener" : "removeEventListener"]("deviceorientation", follow);
  };
}
