// Helpers that create DOM elements.
"use strict";

const byId = (id) => document.getElementById(id);

function element(tag, text, name) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  if (name) made.className = name;
  return made;
}

function button(text, disabled, pressed) {
  const made = element("button", text);
  made.type = "button";
  made.disabled = disabled;
  made.addEventListener("click", pressed);
  return made;
}
