// Requests of the pages to their service: JSON and server-sent events, with a token if the service requires one.
"use strict";

class NoToken extends Error {}

// Takes over the session with which a sign-in ends; a fragment of an address is sent to no server.
if (location.hash.startsWith("#session=")) {
  sessionStorage.setItem("token", decodeURIComponent(location.hash.slice("#session=".length)));
  history.replaceState(null, "", location.pathname);
}

// Shows the link of the sign-in beside the form of the token, if there is a sign-in.
async function offerSignIn(answer) {
  const { sign_in: path } = await answer.json().catch(() => ({}));
  const link = byId("sign-in");
  if (link) link.hidden = !path;
  if (link && path) link.href = path;
}

// Why the service didn't accept a request's token.
const tokenFault = () => (sessionStorage.getItem("token") ? "the token is wrong or no longer valid" : "a token is required");

async function request(path, signal) {
  const token = sessionStorage.getItem("token");
  const answer = await fetch(path, { signal, headers: token ? { Authorization: `Bearer ${token}` } : {} });
  if (answer.status === 401) {
    await offerSignIn(answer);
    throw new NoToken();
  }
  if (!answer.ok) throw await errorOf(answer);
  return answer;
}

// The service's error message: {where, cause, remedy}.
async function errorOf(answer) {
  const error = await answer.json().catch(() => ({}));
  return new Error(error.cause ? `${error.where}: ${error.cause}. ${error.remedy}` : `status ${answer.status}`);
}

// Sends a request with a body, of type JSON by default.
async function send(method, path, body, type) {
  const token = sessionStorage.getItem("token");
  const headers = { "Content-Type": type ?? "application/json", ...(token ? { Authorization: `Bearer ${token}` } : {}) };
  const answer = await fetch(path, { method, headers, body });
  if (!answer.ok) throw await errorOf(answer);
}

// Calls `callback` with each event of a stream until it ends or is silent for `timeout` ms.
async function followEvents(path, signal, callback, timeout = 10000) {
  const reader = (await request(path, signal)).body.pipeThrough(new TextDecoderStream()).getReader();
  for (let text = ""; ;) {
    let timer;
    const silence = new Promise((_, fail) => {
      timer = setTimeout(() => fail(new Error("silent")), timeout);
    });
    const { done, value } = await Promise.race([reader.read(), silence]).finally(() => clearTimeout(timer));
    if (done) throw new Error("ended");
    const events = (text + value).split("\n\n");
    text = events.pop();
    for (const event of events) callback(JSON.parse(event.slice("data: ".length)));
  }
}
