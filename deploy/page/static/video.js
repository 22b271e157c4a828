// Live video: H.264 over WebRTC, one picture for each camera, with its age and its losses.
import { Socket } from "./socket.js";

const PIECE = 400;       // characters: the server takes no long message from anybody
const LOOK_MS = 500;     // between looks at losses and ages
const OVER = 4;          // looks over which losses and delays are taken: 2 s
const STALE_MS = 500;    // a picture that is not replaced for so long stands still
const PATIENCE_MS = 4000; // for the first picture, before its lack is an alarm
const GIVE_UP_MS = 8000; // without any picture: begin again
const KEPT = 32;         // times of pictures that are remembered
const RTP_TIMES = 2 ** 32; // RTP times have 32 bits

export class Video {
  constructor(view, token, say) {
    Object.assign(this, { view, token, say, cameras: [], full: false, peer: null, ahead_ms: null, shortest_ms: Infinity, lacking: performance.now() + PATIENCE_MS });
    view.classList.add("live");
    this.box = document.createElement("div");
    this.box.id = "videos";
    view.append(this.box);
    this.socket = new Socket("/video", {
      opened: socket => socket.send(JSON.stringify({ token })),
      heard: text => this.heard(JSON.parse(text)),
      closed: event => { this.end(); if (event.reason === "token") this.socket.end(); },
    });
    setInterval(() => this.look(), LOOK_MS);
  }

  async heard(said) {
    this.full = Boolean(said.full);
    if (said.cameras) await this.begin(said.cameras);
    if (said.sdp) await this.peer?.setRemoteDescription({ type: "answer", sdp: said.sdp });
  }

  async begin(names) {
    const peer = this.peer = new RTCPeerConnection();  // no server is asked about our address
    this.began = performance.now();
    this.cameras = names.map(name => {
      const figure = document.createElement("figure"), video = document.createElement("video"), caption = document.createElement("figcaption");
      Object.assign(video, { autoplay: true, muted: true, playsInline: true });
      const [title, numbers] = ["name", "numbers"].map(kind => Object.assign(document.createElement("span"), { className: kind }));
      title.textContent = name;
      caption.append(title, numbers);
      figure.append(video, caption);
      figure.onclick = () => this.enlarge(figure.classList.contains("large") ? null : camera);
      this.box.append(figure);
      const camera = { name, figure, video, numbers, taken: new Map(), votes: new Map(), offset: null, delays: [], counts: [], shown: 0, share: 0, delay_ms: null };
      const drawn = (now, { rtpTimestamp, expectedDisplayTime }) => {
        camera.shown = now;
        const taken_s = this.findTime(camera, rtpTimestamp);
        if (taken_s !== undefined && this.ahead_ms !== null) camera.delays.push([now, expectedDisplayTime - (1e3 * taken_s + this.ahead_ms)]);
        video.requestVideoFrameCallback(drawn);
      };
      video.requestVideoFrameCallback(drawn);
      return camera;
    });
    peer.ontrack = ({ track, transceiver, receiver }) => {
      if ("jitterBufferTarget" in receiver) receiver.jitterBufferTarget = 0;  // the newest picture, not the smoothest motion
      this.cameras[peer.getTransceivers().indexOf(transceiver)].video.srcObject = new MediaStream([track]);
    };
    const channel = this.channel = peer.createDataChannel("times", { ordered: false, maxRetransmits: 0 });
    channel.onmessage = ({ data }) => this.told(JSON.parse(data));
    const codecs = RTCRtpReceiver.getCapabilities("video").codecs.filter(one => /H264|rtx/.test(one.mimeType));
    for (const _ of names) peer.addTransceiver("video", { direction: "recvonly" }).setCodecPreferences(codecs);
    await peer.setLocalDescription(await peer.createOffer());
    const offer = peer.localDescription.sdp;
    for (let at = 0; at < offer.length; at += PIECE) this.socket.send(offer.slice(at, at + PIECE));
    this.socket.send("");
  }

  // Either when a picture was taken, or the answer to a comparison of clocks. As in NTP, that of the shortest way counts.
  told(said) {
    if ("taken_s" in said) {
      const { taken } = this.cameras[said.camera];
      taken.set(said.pts, said.taken_s);
      if (taken.size > KEPT) taken.delete(taken.keys().next().value);
      return;
    }
    const now = performance.now(), way_ms = now - said.at_ms;
    if (way_ms >= this.shortest_ms) return;
    this.shortest_ms = way_ms;
    this.ahead_ms = said.at_ms + way_ms / 2 - 1e3 * said.now_s;
  }

  // When a picture was taken. Its RTP time is the number of the report and an offset that the sender has drawn: the one on which most pairs agree.
  findTime(camera, rtp) {
    const { taken, votes } = camera;
    if (camera.offset === null) {
      for (const pts of taken.keys()) {
        const offset = ((rtp - pts) % RTP_TIMES + RTP_TIMES) % RTP_TIMES;
        votes.set(offset, (votes.get(offset) ?? 0) + 1);
        if (votes.get(offset) > KEPT / 2) camera.offset = offset;
      }
    }
    const first = [...taken.keys()].find(pts => (pts + camera.offset) % RTP_TIMES === rtp);
    return camera.offset === null ? undefined : taken.get(first);
  }

  async look() {
    if (!this.peer) return;
    const now = performance.now();
    if (document.hidden) { this.began = now; return; }  // a page that nobody sees draws nothing
    if (this.channel.readyState === "open") this.channel.send(JSON.stringify({ at_ms: now }));
    this.shortest_ms += 0.01;  // clocks drift: a later exchange may count again
    const every = [...(await this.peer.getStats()).values()].filter(one => one.type === "inbound-rtp");
    for (const [index, camera] of this.cameras.entries()) {
      const mid = this.peer?.getTransceivers()[index]?.mid, stats = every.find(one => one.mid === mid);
      if (stats) camera.counts = [...camera.counts.slice(-OVER), [stats.packetsLost, stats.packetsReceived]];
      const [lost, got] = [0, 1].map(what => (camera.counts.at(-1)?.[what] ?? 0) - (camera.counts[0]?.[what] ?? 0));
      camera.share = lost + got > 0 ? Math.max(0, lost) / (lost + got) : 0;
      camera.delays = camera.delays.filter(([at]) => now - at < OVER * LOOK_MS);
      const delays = camera.delays.map(([, delay_ms]) => delay_ms).sort((a, b) => a - b);
      camera.delay_ms = delays.length ? delays[Math.floor(0.95 * (delays.length - 1))] : null;
      const stale = now - camera.shown > STALE_MS;
      camera.figure.classList.toggle("stale", stale);
      const age = camera.delay_ms === null ? "– ms" : `${Math.round(camera.delay_ms)} ms`;
      camera.numbers.textContent = stale ? this.say("no picture") : `${age} · ${(100 * camera.share).toFixed(1)} % ${this.say("packets lost")}`;
    }
    const newest = Math.max(this.began, ...this.cameras.map(one => one.shown));
    if (now - newest > GIVE_UP_MS) this.socket.socket.close();
  }

  // What lacks now; a dead or silent video process and a lost link look the same from here.
  listAlarms(now) {
    if (this.cameras.length && this.cameras.every(one => one.shown)) this.lacking = 0;
    if (now < this.lacking) return [];
    const stale = this.cameras.filter(one => now - one.shown > STALE_MS).map(one => one.name);
    if (this.full) return [{ level: "alarm", name: "no live picture", detail: "watched elsewhere" }];
    if (this.cameras.length && !stale.length) return [];
    return [{ level: "alarm", name: "no live picture", detail: this.cameras.length === stale.length ? "" : stale.join(", ") }];
  }

  enlarge(chosen) {
    for (const camera of this.cameras) camera.figure.classList.toggle("large", camera === chosen);
  }

  enlargeNext() {
    const large = this.cameras.findIndex(one => one.figure.classList.contains("large"));
    this.enlarge(this.cameras[large + 1] ?? null);
  }

  end() {
    this.peer?.close();
    this.peer = null;
    Object.assign(this, { cameras: [], ahead_ms: null, shortest_ms: Infinity });
    this.box.replaceChildren();
  }
}
