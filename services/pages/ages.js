// Clocks and ages, shared by the driver page and its worker.
"use strict";

const MAX_AGE = 275; // age in ms above which video, or the state of vehicle or station, is covered: drawn within 300 ms

// Time in ms on a clock that page and worker share, and that no NTP daemon sets back.
const now = () => performance.timeOrigin + performance.now();
const age = (since) => now() - since;
const sinceText = (since) => (Number.isFinite(since) ? ` since ${(age(since) / 1000).toFixed(1)} s` : "");

// Converts times of the station's clock to this page's clock. The station reads its clock after the page has sent its own
// time, so each difference is a lower bound, and the largest is the closest: ages are never too small, whatever the delay.
class Clock {
  static KEPT = 16; // differences kept: those of the last 3 s

  constructor() {
    this.differences = [];
  }

  addAnswer(sent, station) {
    this.differences = [...this.differences, sent - station].slice(-Clock.KEPT);
  }

  toPage(station) {
    return station + Math.max(...this.differences);
  }
}
