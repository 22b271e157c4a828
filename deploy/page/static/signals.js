// Tones and vibration for what must be noticed without looking: a browser plays them after the first touch or key.
const TONES = {  // frequency in Hz, beginning and length in s
  alarm: [[880, 0, 0.18], [587, 0.2, 0.18], [880, 0.4, 0.18], [587, 0.6, 0.3]],
  "button due": [[660, 0, 0.06]],
  "button now": [[660, 0, 0.1], [990, 0.11, 0.2]],
  "button off": [[440, 0, 0.12]],
  inserted: [[784, 0, 0.12], [988, 0.13, 0.12], [1175, 0.26, 0.4]],
};
const SHAKES = { alarm: [250, 80, 250, 80, 250], "button due": [40], "button now": [150], "button off": [60], inserted: [400] };  // ms on, off, on
const VOLUME = 0.25;

export class Signals {
  constructor(heard) {
    this.on = true;
    this.heard = heard;
    this.context = null;
    for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, () => { if (this.on) this.wake(); }, { passive: true });
  }

  wake() {
    this.context ??= new AudioContext();
    if (this.context.state === "suspended") this.context.resume();
  }

  give(name) {
    if (!this.on) return;
    this.heard(name);
    if (navigator.userActivation?.hasBeenActive) navigator.vibrate?.(SHAKES[name]);
    if (this.context?.state !== "running") return;
    const start = this.context.currentTime;
    for (const [hz, after, length] of TONES[name]) {
      const tone = this.context.createOscillator(), volume = this.context.createGain();
      tone.frequency.value = hz;
      volume.gain.setValueAtTime(VOLUME, start + after);
      volume.gain.exponentialRampToValueAtTime(0.001, start + after + length);
      tone.connect(volume).connect(this.context.destination);
      tone.start(start + after);
      tone.stop(start + after + length);
    }
  }
}
