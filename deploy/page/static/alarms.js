// The alarm list: what is wrong now, the gravest first, and for a while what has just passed.
const KEPT_MS = 10000;  // an alarm that came and went within a blink is still read

export class AlarmList {
  constructor(list) {
    this.list = list;
    this.known = new Map();  // by key: the alarm, its place among those of its time, when it began, and when it ended (null while it lasts)
    this.drawn = "";
  }

  // Draws the alarms and returns whether a grave one is new; tell makes words of an alarm.
  draw(alarms, tell, now) {
    const keys = new Set();
    let fresh = false;
    for (const [place, alarm] of alarms.entries()) {
      const key = `${alarm.level} ${alarm.name} ${alarm.detail.replace(/[\d.]+ ms$/, "")}`, before = this.known.get(key);
      keys.add(key);
      if (!before || before.ended !== null) fresh ||= alarm.level === "alarm";
      this.known.set(key, { alarm, place, began: before && before.ended === null ? before.began : now, ended: null });
    }
    for (const [key, one] of this.known) {
      if (keys.has(key)) continue;
      one.ended ??= now;
      if (now - one.ended > KEPT_MS) this.known.delete(key);
    }
    const order = one => (one.ended === null ? 0 : 2) + (one.alarm.level === "alarm" ? 0 : 1);
    const lines = [...this.known.values()].sort((a, b) => order(a) - order(b) || a.place - b.place).map(one => ({
      kind: one.ended === null ? one.alarm.level : "over",
      text: `${tell(one.alarm)} · ${Math.floor(((one.ended ?? now) - one.began) / 1000)} s`,
    }));
    const drawn = JSON.stringify(lines);
    if (drawn !== this.drawn) {
      this.drawn = drawn;
      this.list.hidden = lines.length === 0;
      this.list.replaceChildren(...lines.map(({ kind, text }) => {
        const item = document.createElement("li");
        item.className = kind;
        item.textContent = text;
        return item;
      }));
    }
    return fresh;
  }
}
