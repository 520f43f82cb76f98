// A page that was opened as a file may start no worker, so that its search would find nothing: here a hidden frame runs the script.
if (location.protocol === "file:") {
  window.IFrameWorker = window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.onmessage = this.onerror = null;
      this.waiting = [];
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const inside = frame.contentWindow, page = inside.document;
      const load = source => new Promise((done, failed) => {
        const script = page.createElement("script");
        script.src = source;
        script.onload = done;
        script.onerror = () => failed(new Error(`${source} cannot be loaded`));
        page.head.append(script);
      });
      inside.parent.IFrameWorker = window.IFrameWorker;
      inside.postMessage = data => this.answer(data);
      inside.importScripts = (...sources) => sources.reduce((before, each) => before.then(() => load(each)), Promise.resolve());
      this.inside = inside;
      load(new URL(url, location.href).href).then(() => { this.ready = true; this.waiting.splice(0).forEach(data => this.tell(data)); });
    }
    answer(data) {
      const event = new MessageEvent("message", { data });
      this.dispatchEvent(event);
      if (this.onmessage) this.onmessage(event);
    }
    tell(data) { this.inside.dispatchEvent(new this.inside.MessageEvent("message", { data })); }
    postMessage(data) { this.ready ? this.tell(data) : this.waiting.push(data); }
    terminate() { this.inside.frameElement.remove(); }
  };
}
