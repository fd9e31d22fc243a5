// Search of the documentation opened as a file: browsers refuse workers there, so the worker's script runs in a hidden
// frame. Material looks for the name IFrameWorker. Without this file, the theme would load such a script from the web.
if (location.protocol === "file:") {
  window.IFrameWorker = window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      this.ready = new Promise((resolve) => {
        frame.onload = () => resolve(this.load(frame.contentWindow, url));
      });
      frame.srcdoc = "<!doctype html>";
      document.body.appendChild(frame);
    }

    async load(inner, url) {
      const add = (source) =>
        new Promise((resolve, reject) => {
          const script = inner.document.createElement("script");
          Object.assign(script, { src: source, onload: resolve, onerror: reject });
          inner.document.body.appendChild(script);
        });
      inner.importScripts = (...sources) => sources.reduce((before, one) => before.then(() => add(one)), Promise.resolve());
      inner.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      await add(url);
      return inner;
    }

    postMessage(data) {
      this.ready.then((inner) => inner.dispatchEvent(new inner.MessageEvent("message", { data })));
    }

    terminate() {}
  };
}
