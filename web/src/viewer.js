// The stage: two pictures of one size, a line between them, zoom and pan. State: where the picture lies and the line.

export class Viewer {
  constructor(stage, canvas, handle, onChange) {
    Object.assign(this, { stage, canvas, handle, onChange, pictures: [], split: 0.5, scale: 1, x: 0, y: 0, fitted: true });
    new ResizeObserver(() => (this.fitted ? this.fit() : this.draw())).observe(stage);
    this.listen();
  }

  /** Show two pictures, RGBA ImageData of one size; the view stays where it is unless the size is new. */
  show(left, right) {
    const before = this.pictures[0];
    this.pictures = [left, right].map((data, k) => {
      const own = before?.width === data.width && before?.height === data.height ? this.pictures[k] : new OffscreenCanvas(data.width, data.height);
      own.getContext("2d").putImageData(data, 0, 0);
      return own;
    });
    this.handle.hidden = false;
    if (before?.width === left.width && before?.height === left.height) this.draw();
    else this.fit();
  }

  get ratio() { return window.devicePixelRatio || 1; }

  /** The whole picture in the middle of the stage. */
  fit() {
    const [picture] = this.pictures, { clientWidth: w, clientHeight: h } = this.stage;
    if (!picture) return;
    this.fitted = true;
    this.scale = Math.min(w / picture.width, h / picture.height);
    this.x = (w - picture.width * this.scale) / 2;
    this.y = (h - picture.height * this.scale) / 2;
    this.draw();
  }

  /** Zoom to `scale` CSS pixels per picture's pixel around a point of the stage; its middle if none is given. */
  zoom(scale, x = this.stage.clientWidth / 2, y = this.stage.clientHeight / 2) {
    if (!this.pictures.length) return;
    scale = Math.min(Math.max(scale, 0.05), Math.max(this.scale, 32));  // tiny pictures fit at more
    this.x = x - ((x - this.x) * scale) / this.scale;
    this.y = y - ((y - this.y) * scale) / this.scale;
    this.scale = scale;
    this.fitted = false;
    this.draw();
  }

  actual() { this.zoom(1 / this.ratio); }

  /** The picture's pixel under a point of the stage, or null. */
  pixelAt(x, y) {
    const [picture] = this.pictures, c = Math.floor((x - this.x) / this.scale), r = Math.floor((y - this.y) / this.scale);
    return picture && c >= 0 && r >= 0 && c < picture.width && r < picture.height ? [r, c] : null;
  }

  setSplit(share) {
    this.split = Math.min(Math.max(share, 0), 1);
    this.draw();
  }

  draw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = 0;
      this.paint();
    });
  }

  paint() {
    const { stage, canvas, ratio } = this, w = stage.clientWidth, h = stage.clientHeight;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
    }
    const context = canvas.getContext("2d"), [left, right] = this.pictures;
    context.clearRect(0, 0, canvas.width, canvas.height);
    if (!left) return;
    // The line lies in the part of the picture that is seen, so that it is always at hand.
    const first = Math.max(this.x, 0), last = Math.min(this.x + left.width * this.scale, w);
    const line = first + (last - first) * this.split;
    context.imageSmoothingEnabled = this.scale * ratio < 1;
    context.imageSmoothingQuality = "high";
    for (const [picture, begin, end] of [[left, 0, line], [right, line, w]]) {
      context.save();
      context.beginPath();
      context.rect(begin * ratio, 0, (end - begin) * ratio, h * ratio);
      context.clip();
      context.setTransform(this.scale * ratio, 0, 0, this.scale * ratio, Math.round(this.x * ratio), Math.round(this.y * ratio));
      context.drawImage(picture, 0, 0);
      context.restore();
    }
    this.handle.style.left = `${line}px`;
    this.handle.setAttribute("aria-valuenow", Math.round(100 * this.split));
    this.onChange();
  }

  listen() {
    const { stage, handle, canvas } = this, pointers = new Map();
    const local = (event) => {
      const box = stage.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    handle.addEventListener("pointerdown", (event) => handle.setPointerCapture(event.pointerId));
    handle.addEventListener("pointermove", (event) => {
      if (!handle.hasPointerCapture(event.pointerId)) return;
      const first = Math.max(this.x, 0), last = Math.min(this.x + this.pictures[0].width * this.scale, stage.clientWidth);
      this.setSplit((local(event)[0] - first) / Math.max(last - first, 1));
    });
    handle.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key];
      if (!step) return;
      event.preventDefault();  // the page does not scroll
      this.setSplit(this.split + step);
    });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, local(event));
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId), now = local(event);
      if (!before) return;
      if (pointers.size === 2) {  // two fingers: zoom around the one that rests
        const [, still] = [...pointers].find(([id]) => id !== event.pointerId);
        const length = ([x, y]) => Math.hypot(x - still[0], y - still[1]);
        this.zoom((this.scale * length(now)) / Math.max(length(before), 1), ...still);
      } else {
        this.x += now[0] - before[0];
        this.y += now[1] - before[1];
        this.fitted = false;
        this.draw();
      }
      pointers.set(event.pointerId, now);
    });
    stage.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(this.scale * Math.exp(-event.deltaY / (event.ctrlKey ? 100 : 400)), ...local(event));
    }, { passive: false });
    canvas.addEventListener("dblclick", (event) => (this.fitted ? this.zoom(1 / this.ratio, ...local(event)) : this.fit()));
  }
}
