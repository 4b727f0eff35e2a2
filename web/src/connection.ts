// The WebSocket: it comes back by itself, says what the page holds already, and checks what it was told.

import { PROTOCOL, type Vec3 } from "./wire";

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 8000;
const ALIVE_MS = 15000;

export type LinkState = "connecting" | "open" | "lost" | "refused";

export interface Listener {
  /// What the page holds, for the first message.
  held(): { map_id: string; epoch: number; chunks: [number, number, number, number][] };
  text(text: string): void;
  binary(bytes: ArrayBuffer): void;
  link(state: LinkState, reason: string): void;
}

export class Connection {
  private socket: WebSocket | null = null;
  private wait = FIRST_WAIT_MS;
  private timer = 0;
  private isStopped = false;
  /// Why the server let go, in its own words.
  private reason = "";

  constructor(
    private readonly listener: Listener,
    private readonly budget: { max_splats: number; sh_degree: number },
  ) {
    window.setInterval(() => this.say({ type: "alive" }), ALIVE_MS);
  }

  open(): void {
    this.isStopped = false;
    window.clearTimeout(this.timer);
    this.listener.link("connecting", "");
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/ws`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.wait = FIRST_WAIT_MS;
      this.reason = "";
      this.say({ type: "hello", protocol: PROTOCOL, ...this.budget, ...this.listener.held() });
      this.listener.link("open", "");
    };
    socket.onmessage = (event: MessageEvent<string | ArrayBuffer>) => {
      if (typeof event.data === "string") {
        this.listener.text(event.data);
      } else {
        this.listener.binary(event.data);
      }
    };
    socket.onclose = () => this.closed(socket);
  }

  /// The server says that it will close, and why.
  bye(reason: string): void {
    this.reason = reason;
  }

  close(): void {
    this.isStopped = true;
    window.clearTimeout(this.timer);
    this.socket?.close();
  }

  /// The page holds nothing any more.
  resync(): void {
    this.say({ type: "resync" });
  }

  eye(position: Vec3): void {
    if (position.every(Number.isFinite)) {
      this.say({ type: "eye", position });
    }
  }

  private say(message: object): void {
    if (this.socket?.readyState === WebSocket.OPEN) {
      this.socket.send(JSON.stringify(message));
    }
  }

  private closed(socket: WebSocket): void {
    if (socket !== this.socket) {
      return;
    }
    this.socket = null;
    this.listener.link(this.reason ? "refused" : "lost", this.reason);
    if (!this.isStopped) {
      this.timer = window.setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(2 * this.wait, LONGEST_WAIT_MS);
    }
  }
}
