// Search in pages that are opened as files. Browsers start no worker from a file; a frame that is not shown does its work.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.appendChild(frame);
      this.inside = frame.contentWindow;
      this.loaded = new Promise((resolve) => (this.inside.done = resolve));
      this.inside.postMessage = (data) => {
        const event = new MessageEvent("message", { data });
        this.dispatchEvent(event);
        if (this.onmessage) this.onmessage(event);
      };
      const script = (source) => `<script src="${source}"><\/script>`;
      this.inside.importScripts = (...sources) => this.inside.document.write(sources.map(script).join(""));
      this.inside.document.write(script(new URL(url, location.href)) + "<script>done()<\/script>");
      this.inside.document.close();
    }
    postMessage(data) {
      this.loaded.then(() => this.inside.dispatchEvent(new this.inside.MessageEvent("message", { data })));
    }
    terminate() {
      this.inside.frameElement.remove();
    }
  };
}
