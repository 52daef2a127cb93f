// History of the certified maps that were shown, for playback and for saving as a film.

const MAX_BYTES = 96 * 2 ** 20;
const MAX_MAPS = 1500;
const PER_SECOND = 30;

const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

export class Film {
  constructor() {
    this.clear();
  }

  clear() {
    this.maps = [];
    this.bytes = 0;
    this.playing = false;
  }

  /** Add a map; beyond a limit remove every second map, so that the film keeps its duration and gets coarser. */
  add(places) {
    if (this.playing) return;
    this.maps.push(places);
    this.bytes += places.byteLength;
    if (this.bytes > MAX_BYTES || this.maps.length > MAX_MAPS) {
      this.maps = this.maps.filter((_, i) => i % 2 === 1);
      this.bytes = this.maps.reduce((sum, map) => sum + map.byteLength, 0);
    }
  }

  /** Show all maps, then restore the previous view. */
  async play(view, shown = () => {}) {
    if (this.playing || !this.maps.length) return;
    this.playing = true;
    const { places, bad } = view.scene;
    for (const map of this.maps) {
      view.show(map);
      await pause(1000 / PER_SECOND);
      shown();
    }
    view.show(places, bad);
    this.playing = false;
  }

  /** Record the playback as a film; return null if the browser does not support it. */
  async record(view) {
    if (!window.MediaRecorder || !HTMLCanvasElement.prototype.captureStream) return null;
    const canvas = view.picture();
    const context = canvas.getContext("2d");
    const type = ["video/webm;codecs=vp9", "video/webm", "video/mp4"].find((one) => MediaRecorder.isTypeSupported(one));
    if (!type) return null;
    const recorder = new MediaRecorder(canvas.captureStream(PER_SECOND), { mimeType: type, videoBitsPerSecond: 6_000_000 });
    const parts = [];
    recorder.ondataavailable = (event) => parts.push(event.data);
    const stopped = new Promise((resolve) => (recorder.onstop = resolve));
    recorder.start();
    await this.play(view, () => context.drawImage(view.picture(), 0, 0));
    recorder.stop();
    await stopped;
    return new Blob(parts, { type });
  }
}
