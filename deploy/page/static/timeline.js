// The timeline of a recording that is played: where it is, what happened in it, and wishes to move along it.
const clock = seconds => `${Math.floor(seconds / 60)}:${(seconds % 60).toFixed(1).padStart(4, "0")}`;

export class Timeline {
  constructor(section, wish) {
    this.section = section;
    [this.play, this.speed, this.position, this.marks, this.time] = ["#play", "#speed", "#position", "#marks", "output"].map(name => section.querySelector(name));
    this.drawn = "";
    this.held = false;  // while a finger is on the knob it does not run away
    this.play.onclick = () => wish("play", this.playing ? "off" : this.speed.value);
    this.speed.onchange = () => wish("play", this.speed.value);
    this.position.oninput = () => { this.held = true; wish("seek", Number(this.position.value).toFixed(2)); };
    this.position.onchange = () => { this.held = false; };
  }

  get playing() { return this.play.getAttribute("aria-pressed") === "true"; }

  draw(replay, say) {
    this.section.hidden = !replay;
    if (!replay) return;
    const { position_s, duration_s, speed, marks } = replay;
    this.play.setAttribute("aria-pressed", speed > 0 && position_s < duration_s);
    this.play.setAttribute("aria-label", say(this.playing ? "pause" : "play"));
    this.position.max = duration_s;
    if (!this.held) this.position.value = position_s;
    this.time.textContent = `${clock(position_s)} / ${clock(duration_s)}`;
    const drawn = JSON.stringify([marks, say("play")]);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    this.position.setAttribute("aria-label", say("position in the recording"));
    this.speed.setAttribute("aria-label", say("speed"));
    this.marks.replaceChildren(...marks.map(mark => {
      const node = document.createElement("i");
      node.dataset.kind = mark.kind;
      node.title = `${clock(mark.t_s)} ${say(mark.name)}`;
      node.style.left = `${100 * mark.t_s / Math.max(duration_s, 1e-9)}%`;
      return node;
    }));
  }
}
