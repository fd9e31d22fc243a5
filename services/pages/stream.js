// What pages ask their service for: JSON and streams of events, with a token where it wants one.
"use strict";

class NoToken extends Error {}

async function ask(path, signal) {
  const token = sessionStorage.getItem("token");
  const answer = await fetch(path, { signal, headers: token ? { Authorization: `Bearer ${token}` } : {} });
  if (answer.status === 401) throw new NoToken();
  if (!answer.ok) {
    const told = await answer.json().catch(() => ({}));
    throw new Error(told.cause ? `${told.where}: ${told.cause}. ${told.remedy}` : `status ${answer.status}`);
  }
  return answer;
}

// Has a service do something, with a body of JSON unless it says otherwise.
async function send(method, path, body, type) {
  const token = sessionStorage.getItem("token");
  const headers = { "Content-Type": type ?? "application/json", ...(token ? { Authorization: `Bearer ${token}` } : {}) };
  const answer = await fetch(path, { method, headers, body });
  if (answer.ok) return;
  const told = await answer.json().catch(() => ({}));
  throw new Error(told.cause ? `${told.where}: ${told.cause}. ${told.remedy}` : `status ${answer.status}`);
}

// Calls `taken` with each event of a stream, until it ends or is silent for `longest` ms.
async function follow(path, signal, taken, longest = 10000) {
  const reader = (await ask(path, signal)).body.pipeThrough(new TextDecoderStream()).getReader();
  for (let text = ""; ;) {
    let timer;
    const silence = new Promise((_, fail) => {
      timer = setTimeout(() => fail(new Error("silent")), longest);
    });
    const { done, value } = await Promise.race([reader.read(), silence]).finally(() => clearTimeout(timer));
    if (done) throw new Error("ended");
    const events = (text + value).split("\n\n");
    text = events.pop();
    for (const event of events) taken(JSON.parse(event.slice("data: ".length)));
  }
}
