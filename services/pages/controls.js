// The driver's input from keyboard, gamepads and the page's brake button. The strongest brake of all devices applies,
// whichever device steers, and overrides the throttle.
"use strict";

const PERIOD = 20; // interval between two commands, ms
const BRAKES = ["Space", "ArrowDown", "KeyS", "Button"]; // codes of the brake keys, and of the page's brake button
const DEAD_ZONE = 0.05; // of a gamepad's stick and triggers, which rarely rest at exactly 0
const STICK = 0,
  LEFT_TRIGGER = 6,
  RIGHT_TRIGGER = 7; // indices of the standard gamepad mapping

const pressed = new Set(),
  keys = { steering: 0, throttle: 0, brake: 0 }; // of keyboard and brake button, ramped
let gamepad = null; // index of the gamepad in use; null: keyboard

const any = (...codes) => codes.some((code) => pressed.has(code));
const gamepads = () => [...(navigator.getGamepads?.() ?? [])].filter((one) => one?.connected);
const beyondDeadZone = (value = 0) => (Math.abs(value) < DEAD_ZONE ? 0 : value);

// Moves a value towards its target by at most `rate` per second.
function ramped(value, target, rate) {
  const step = rate * (PERIOD / 1000);
  return Math.abs(target - value) <= step ? target : value + Math.sign(target - value) * step;
}

// Current steering, throttle and brake; null: the gamepad in use was unplugged.
function controls() {
  const pads = gamepads(),
    pad = pads.find((one) => one.index === gamepad);
  if (gamepad !== null && !pad) return null;
  keys.brake = ramped(keys.brake, any(...BRAKES) ? 1 : 0, 5);
  const brake = Math.max(keys.brake, ...pads.map((one) => beyondDeadZone(one.buttons[LEFT_TRIGGER]?.value)));
  const turn = (any("ArrowLeft", "KeyA") ? 1 : 0) - (any("ArrowRight", "KeyD") ? 1 : 0),
    ahead = any("ArrowUp", "KeyW");
  keys.steering = ramped(keys.steering, turn, turn ? 1.6 : 3);
  keys.throttle = brake > 0 ? 0 : ramped(keys.throttle, ahead ? 1 : 0, ahead ? 1.2 : 5);
  const steering = pad ? -beyondDeadZone(pad.axes[STICK]) : keys.steering,
    throttle = pad ? beyondDeadZone(pad.buttons[RIGHT_TRIGGER]?.value) : keys.throttle;
  return { steering, throttle: brake > 0 ? 0 : throttle, brake };
}

// Uses the first gamepad on which a button is pressed.
function chooseGamepad() {
  gamepad ??= gamepads().find((one) => one.buttons.some((button) => button.pressed))?.index ?? null;
}

function resetControls() {
  pressed.clear();
  gamepad = null;
  Object.assign(keys, { steering: 0, throttle: 0, brake: 0 });
}

addEventListener("keyup", (event) => pressed.delete(event.code));
// Without focus the release of a key isn't reported: all keys are released except brakes, which hold until focus returns.
addEventListener("blur", () => {
  for (const code of pressed) if (!BRAKES.includes(code)) pressed.delete(code);
});
addEventListener("focus", () => pressed.clear());
