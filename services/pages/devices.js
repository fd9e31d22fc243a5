// Gamepads, wheels and pedals: which axis or button is what, with dead zones and curves; stored for each device.
//
// A profile: {steering, throttle, brake, emergency}. `steering` is an axis with its values at full left and full right.
// `throttle` and `brake` are {axis} or {button} with the values at rest and fully pressed, so that inverted pedals are
// no special case. `dead`: share of the range that counts as rest; `curve`: exponent (2: finer near rest).
// `emergency`: index of a button.
"use strict";

const STANDARD = {
  name: "standard gamepad",
  steering: { axis: 0, left: -1, right: 1, dead: 0.05, curve: 1 },
  throttle: { button: 7, rest: 0, full: 1, dead: 0.05, curve: 1 },
  brake: { button: 6, rest: 0, full: 1, dead: 0.05, curve: 1 },
  emergency: 1,
}; // https://www.w3.org/TR/gamepad/#remapping

// Wheels report the values of their axes as the system does: pedals are 1 at rest and -1 fully pressed.
const wheel = (name, throttle, brake, emergency) => ({
  name,
  steering: { axis: 0, left: -1, right: 1, dead: 0.01, curve: 1 },
  throttle: { axis: throttle, rest: 1, full: -1, dead: 0.03, curve: 1 },
  brake: { axis: brake, rest: 1, full: -1, dead: 0.03, curve: 1 },
  emergency,
});
const LINUX = /Linux/.test(navigator.userAgent);
const PROFILES = [
  [/046d.*(c24f|c260)|G29/i, wheel("Logitech G29", 2, LINUX ? 3 : 5, 1)],
  [/046d.*(c266|c267|c26e)|G923/i, wheel("Logitech G923", 2, LINUX ? 3 : 5, 1)],
  [/044f.*(b66e|b66d|b677|b67f|b696|b669)|Thrustmaster.*(T150|T300|T248|TMX|T-GT)/i, wheel("Thrustmaster wheel", LINUX ? 2 : 5, 1, 1)],
]; // by vendor, product and name in Gamepad.id

const REST_SHARE = 0.1; // a pedal was at rest once it was this close to it

const storageKey = (pad) => `device ${pad.id}`;

// Profile of a device: as calibrated, else that of its model, else the standard mapping; null: there is none.
function profileOf(pad) {
  try {
    const stored = JSON.parse(localStorage.getItem(storageKey(pad)));
    if (stored) return stored;
  } catch {
    localStorage.removeItem(storageKey(pad));
  }
  const known = PROFILES.find(([pattern]) => pattern.test(pad.id));
  return known ? known[1] : pad.mapping === "standard" ? STANDARD : null;
}

function storeProfile(pad, profile) {
  if (profile) localStorage.setItem(storageKey(pad), JSON.stringify(profile));
  else localStorage.removeItem(storageKey(pad));
}

const raw = (pad, input) => (input.axis === undefined ? pad.buttons[input.button]?.value : pad.axes[input.axis]) ?? NaN;

// Applies dead zone and curve to a share of 0 to 1.
function shaped(share, { dead = 0, curve = 1 }) {
  const beyond = Math.min(Math.max((share - dead) / (1 - dead), 0), 1);
  return beyond ** curve;
}

// Share of 0 to 1 to which a pedal is pressed.
function pedal(pad, input) {
  const share = (raw(pad, input) - input.rest) / (input.full - input.rest);
  return Number.isFinite(share) ? shaped(share, input) : 0;
}

// Steering from -1 (full right) to 1 (full left).
function steeringOf(pad, input) {
  const centre = (input.left + input.right) / 2,
    share = (raw(pad, input) - centre) / (input.left - centre);
  return Number.isFinite(share) ? Math.sign(share) * shaped(Math.abs(share), input) : 0;
}

const rested = new Set(); // pedals that have been at rest since the device was connected

// Many devices report 0 for each axis until it is moved, which is half of a pedal whose range is 1 to -1. So a throttle
// counts once it was at rest; a brake always counts, as it may be pressed.
function hasRested(pad, what, input) {
  const key = `${pad.index} ${pad.id} ${what}`;
  if (Math.abs(raw(pad, input) - input.rest) <= REST_SHARE * Math.abs(input.full - input.rest)) rested.add(key);
  return rested.has(key);
}

// Current input of a device; null: it has no profile.
function deviceInput(pad) {
  const profile = profileOf(pad);
  if (!profile) return null;
  const ready = [hasRested(pad, "throttle", profile.throttle), hasRested(pad, "brake", profile.brake)].every(Boolean);
  return {
    ready,
    steering: steeringOf(pad, profile.steering),
    throttle: ready ? pedal(pad, profile.throttle) : 0,
    brake: pedal(pad, profile.brake),
    emergency: Boolean(pad.buttons[profile.emergency]?.pressed),
  };
}

addEventListener("gamepaddisconnected", (event) => {
  for (const key of rested) if (key.startsWith(`${event.gamepad.index} `)) rested.delete(key);
});

// Tells the driver by force feedback, where device and browser have it, that the vehicle has stopped.
function rumble(pads) {
  for (const pad of pads) pad.vibrationActuator?.playEffect?.("dual-rumble", { duration: 400, strongMagnitude: 1, weakMagnitude: 0.5 }).catch(() => {});
}
