// The driver's input from keyboard, gamepads, wheels and the page's brake button. The strongest brake of all devices
// applies, whichever device steers, and overrides the throttle.
"use strict";

const PERIOD = 20; // interval between two commands, ms
const BRAKES = ["Space", "ArrowDown", "KeyS", "Button"]; // codes of the brake keys, and of the page's brake button
const STOPS = ["Escape", "Backspace"]; // codes of the emergency keys

const pressed = new Set(),
  keys = { steering: 0, throttle: 0, brake: 0 }; // of keyboard and brake button, ramped
let gamepad = null; // index of the gamepad or wheel in use; null: keyboard

const any = (...codes) => codes.some((code) => pressed.has(code));
const gamepads = () => [...(navigator.getGamepads?.() ?? [])].filter((one) => one?.connected);
const inputs = () => gamepads().map(deviceInput).filter(Boolean);

// Moves a value towards its target by at most `rate` per second.
function ramped(value, target, rate) {
  const step = rate * (PERIOD / 1000);
  return Math.abs(target - value) <= step ? target : value + Math.sign(target - value) * step;
}

// Current steering, throttle and brake; null: the gamepad in use was unplugged.
function controls() {
  const pad = gamepads().find((one) => one.index === gamepad);
  if (gamepad !== null && !pad) return null;
  keys.brake = ramped(keys.brake, any(...BRAKES) ? 1 : 0, 5);
  const brake = Math.max(keys.brake, ...inputs().map((one) => one.brake));
  const turn = (any("ArrowLeft", "KeyA") ? 1 : 0) - (any("ArrowRight", "KeyD") ? 1 : 0),
    ahead = any("ArrowUp", "KeyW");
  keys.steering = ramped(keys.steering, turn, turn ? 1.6 : 3);
  keys.throttle = brake > 0 ? 0 : ramped(keys.throttle, ahead ? 1 : 0, ahead ? 1.2 : 5);
  const { steering, throttle } = (pad && deviceInput(pad)) ?? keys;
  return { steering, throttle: brake > 0 ? 0 : throttle, brake };
}

// Uses the first gamepad or wheel that has a profile and on which a button or the throttle is pressed.
function chooseGamepad() {
  const used = (pad) => pad.buttons.some((button) => button.pressed) || deviceInput(pad).throttle > 0.1;
  gamepad ??= gamepads().find((pad) => profileOf(pad) && used(pad))?.index ?? null;
}

// Whether the emergency button of any device is pressed.
const emergency = () => inputs().some((one) => one.emergency);

// What the driver should know of the devices.
function inputText() {
  const pads = gamepads(),
    inUse = pads.find((one) => one.index === gamepad),
    texts = [];
  if (inUse) texts.push(`${profileOf(inUse)?.name ?? inUse.id} is in use.`);
  for (const pad of pads) {
    const input = deviceInput(pad);
    if (!input) texts.push(`${pad.id} is unknown: set it up under Devices.`);
    else if (!input.ready) texts.push(`Press and release each pedal of ${profileOf(pad).name} once.`);
  }
  return texts.join(" ");
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
