// Search from a folder: browsers start no workers for pages of files, so a hidden frame runs the worker's script.
class FrameWorker extends EventTarget {
  constructor(url) {
    super();
    const frame = document.createElement("iframe");
    frame.hidden = true;
    document.body.append(frame);
    this.frame = frame.contentWindow;
    this.frame.document.open();
    this.frame.document.write(`<body><script>
      postMessage = parent.postMessage.bind(parent);
      importScripts = (...urls) => urls.reduce((before, url) => before.then(() => new Promise((done) => {
        document.body.append(Object.assign(document.createElement("script"), { src: url, onload: done }));
      })), Promise.resolve());
    </` + `script><script src="${url}"></` + "script>");
    this.frame.document.close();
    addEventListener("message", (event) => {
      if (event.source === this.frame) this.dispatchEvent(new MessageEvent("message", { data: event.data }));
    });
  }
  postMessage(data) {
    this.frame.dispatchEvent(new MessageEvent("message", { data }));
  }
}
if (location.protocol === "file:") window.Worker = FrameWorker;
