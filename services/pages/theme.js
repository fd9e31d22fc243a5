// Switch between the light, dark and system theme; runs before anything is drawn.
"use strict";

(() => {
  const NAMES = ["system", "light", "dark"],
    system = matchMedia("(prefers-color-scheme: dark)");
  let chosen = NAMES.includes(localStorage.getItem("theme")) ? localStorage.getItem("theme") : "system";

  function show() {
    document.documentElement.dataset.theme = chosen === "system" ? (system.matches ? "dark" : "light") : chosen;
    const button = document.getElementById("theme");
    if (button) button.textContent = { system: "◐ system", light: "☀ light", dark: "☾ dark" }[chosen];
    dispatchEvent(new Event("theme"));
  }

  show();
  system.addEventListener("change", show);
  addEventListener("DOMContentLoaded", () => {
    show();
    document.getElementById("theme").addEventListener("click", () => {
      chosen = NAMES[(NAMES.indexOf(chosen) + 1) % NAMES.length];
      localStorage.setItem("theme", chosen);
      show();
    });
  });
})();
