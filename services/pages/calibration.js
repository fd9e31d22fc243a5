// Page on which gamepads, wheels and pedals are set up: calibration by moving them, dead zones and curves.
"use strict";

const PERIOD = 50; // interval of updates, ms
const MOVED = 0.3; // smallest change of an axis or button that counts as moved
const STEPS = [
  ["rest", "Release all pedals and the wheel"],
  ["left", "Turn fully to the left, and hold"],
  ["right", "Turn fully to the right, and hold"],
  ["throttle", "Press the throttle fully, and hold"],
  ["brake", "Press the brake fully, and hold"],
  ["emergency", "Press the button for the emergency stop, and hold"],
];

const snapshot = (pad) => ({ axes: [...pad.axes], buttons: pad.buttons.map((one) => one.value) });

// The input that has changed most between two snapshots, {axis} or {button} with both values; null: none has.
function moved(from, to, kinds) {
  const all = kinds.flatMap((kind) => to[kind].map((value, index) => ({ kind, index, rest: from[kind][index], full: value })));
  const most = all.reduce((one, other) => (Math.abs(other.full - other.rest) > Math.abs(one.full - one.rest) ? other : one));
  if (Math.abs(most.full - most.rest) < MOVED) return null;
  const { kind, index, rest, full } = most;
  return kind === "axes" ? { axis: index, rest, full } : { button: index, rest, full };
}

class Device {
  constructor(pad) {
    this.index = pad.index;
    this.taken = []; // snapshots of the calibration so far
    this.card = element("article", undefined, "run");
    this.title = element("b");
    this.bars = ["steering", "throttle", "brake"].map((what) => [what, element("progress")]);
    this.text = element("p");
    this.error = element("p", "", "failure");
    this.next = button("Calibrate", false, () => this.step());
    const meters = element("div", undefined, "bar");
    for (const [what, bar] of this.bars) {
      const label = element("label", `${what} `);
      bar.dataset.what = what;
      label.append(bar);
      meters.append(label);
    }
    this.settings = element("div", undefined, "bar");
    const buttons = element("div", undefined, "choice");
    buttons.append(this.next, button("Use the default", false, () => this.store(null)));
    this.card.append(this.title, meters, this.settings, this.text, this.error, buttons);
    byId("devices").append(this.card);
    this.showSettings();
  }

  get pad() {
    return navigator.getGamepads()[this.index];
  }

  // Dead zone and curve of each input.
  showSettings() {
    const profile = profileOf(this.pad);
    this.settings.replaceChildren();
    for (const what of profile ? ["steering", "throttle", "brake"] : [])
      for (const [field, text, step, max] of [["dead", "dead zone", 0.01, 0.5], ["curve", "curve", 0.1, 3]]) {
        const label = element("label", `${what}, ${text} `),
          input = element("input");
        Object.assign(input, { type: "number", min: field === "dead" ? 0 : 0.3, max, step, value: profile[what][field] });
        input.dataset.setting = `${what} ${field}`;
        input.addEventListener("change", () => {
          if (!input.checkValidity()) return input.reportValidity();
          const now = structuredClone(profileOf(this.pad));
          now[what][field] = Number(input.value);
          this.store(now);
        });
        label.append(input);
        this.settings.append(label);
      }
  }

  store(profile) {
    storeProfile(this.pad, profile);
    this.taken = [];
    this.error.textContent = this.text.textContent = "";
    this.next.textContent = "Calibrate";
    this.showSettings();
  }

  // Begins the calibration, or takes what the driver holds now and continues.
  step() {
    const began = this.next.textContent !== "Calibrate";
    if (began) this.taken.push(snapshot(this.pad));
    this.error.textContent = "";
    if (this.taken.length < STEPS.length) {
      this.text.textContent = `${STEPS[this.taken.length][1]}, then press Next.`;
      this.next.textContent = "Next";
      return;
    }
    const profile = this.calibrated();
    this.store(typeof profile === "string" ? profileOf(this.pad) : profile);
    if (typeof profile === "string") this.error.textContent = profile;
  }

  // Profile of the snapshots; a text: what is wrong.
  calibrated() {
    const [rest, left, right, ...pressed] = this.taken,
      wheel = moved(left, right, ["axes"]),
      [throttle, brake, emergency] = pressed.map((one) => moved(rest, one, ["axes", "buttons"]));
    if (!wheel) return "The wheel did not move between left and right. Calibrate again.";
    if (!throttle || !brake || !emergency) return `No ${!throttle ? "throttle" : !brake ? "brake" : "button"} was pressed. Calibrate again.`;
    if (throttle.axis === wheel.axis || brake.axis === wheel.axis || JSON.stringify([throttle.axis, throttle.button]) === JSON.stringify([brake.axis, brake.button]))
      return "Two functions moved the same axis. Calibrate again, one at a time.";
    if (emergency.button === undefined) return "The emergency stop must be a button. Calibrate again.";
    return {
      name: this.pad.id,
      steering: { axis: wheel.axis, left: wheel.rest, right: wheel.full, dead: 0.02, curve: 1 },
      throttle: { ...throttle, dead: 0.03, curve: 1 },
      brake: { ...brake, dead: 0.03, curve: 1 },
      emergency: emergency.button,
    };
  }

  update() {
    const { pad } = this,
      input = deviceInput(pad);
    this.title.textContent = `${pad.id}: ${profileOf(pad)?.name ?? "unknown, calibrate it"}`;
    for (const [what, bar] of this.bars) bar.value = !input ? 0 : what === "steering" ? (1 - input.steering) / 2 : input[what];
  }
}

const devices = new Map();

setInterval(() => {
  const pads = [...navigator.getGamepads()].filter((one) => one?.connected);
  byId("none").hidden = pads.length > 0;
  for (const [index, one] of devices)
    if (!pads.some((pad) => pad.index === index)) {
      one.card.remove();
      devices.delete(index);
    }
  for (const pad of pads) {
    if (!devices.has(pad.index)) devices.set(pad.index, new Device(pad));
    devices.get(pad.index).update();
  }
}, PERIOD);
