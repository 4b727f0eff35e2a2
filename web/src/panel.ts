// How the mapper is doing: state and reasons, figures, small charts over time.

import { element, readable, show } from "./dom";
import type { LinkState } from "./connection";
import type { MapFacts, Status, TrackedPose, Welcome } from "./wire";

/// Values of a chart.
const MAX_POINTS = 240;

const STATES: Record<string, [string, "good" | "warn" | "bad" | ""]> = {
  initialising: ["Initialising", "warn"],
  tracking: ["Tracking", "good"],
  lost: ["Lost", "bad"],
  relocalised: ["Relocalised", "good"],
  paused: ["Paused", "warn"],
  ended: ["Ended", ""],
  recovering: ["Recovering the GPU", "warn"],
};

class Chart {
  readonly canvas: HTMLCanvasElement;
  private values: number[] = [];

  constructor(
    private readonly name: string,
    private readonly unit: string,
    private readonly digits: number,
  ) {
    this.canvas = element("canvas", { class: "chart", role: "img", "aria-label": name });
  }

  add(value: unknown): void {
    if (typeof value !== "number" || !Number.isFinite(value)) {
      return;
    }
    this.values.push(value);
    if (this.values.length > MAX_POINTS) {
      this.values.shift();
    }
    this.draw();
  }

  private draw(): void {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [this.canvas.clientWidth || 276, this.canvas.clientHeight || 46];
    this.canvas.width = width * ratio;
    this.canvas.height = height * ratio;
    const context = this.canvas.getContext("2d");
    if (!context) {
      return;
    }
    const style = getComputedStyle(this.canvas);
    const colour = (name: string): string => style.getPropertyValue(name).trim();
    context.scale(ratio, ratio);
    const newest = this.values[this.values.length - 1] ?? 0;
    const text = `${this.name} ${readable(newest, this.digits, this.unit)}`;
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = colour("--dim");
    context.fillText(text, 0, 10);
    this.canvas.setAttribute("aria-label", text);
    const top = Math.max(...this.values, 1e-9);
    context.strokeStyle = colour("--accent");
    context.lineWidth = 1.5;
    context.beginPath();
    this.values.forEach((value, k) => {
      const x = (k / Math.max(this.values.length - 1, 1)) * width;
      const y = height - 2 - (value / top) * (height - 18);
      if (k === 0) {
        context.moveTo(x, y);
      } else {
        context.lineTo(x, y);
      }
    });
    context.stroke();
  }
}

export class Panel {
  readonly head: HTMLElement;
  readonly side: HTMLElement;
  readonly note: HTMLElement;
  private readonly chip = element("span", { class: "chip", role: "status", "aria-live": "polite" }, "Connecting");
  private readonly title = element("h1", {}, "splat-mapper");
  private readonly reason = element("span", { class: "reason" });
  private readonly fields = new Map<string, HTMLElement>();
  private readonly warnings = element("ul", { class: "warnings", "aria-label": "Warnings" });
  private readonly charts = {
    steps: new Chart("Optimiser steps/s", "", 0),
    latency: new Chart("Frame to pose, p95", "ms", 0),
    splats: new Chart("Splats", "", 0),
    memory: new Chart("Memory", "MiB", 0),
  };
  private state = "";
  private link: LinkState = "connecting";
  private isLive = false;

  constructor() {
    this.head = element("header", { class: "box head" }, this.title, this.chip, this.reason);
    const field = (key: string, name: string): Node[] => {
      const value = element("dd", {}, "–");
      this.fields.set(key, value);
      return [element("dt", {}, name), value];
    };
    const list = (kind: string, ...rows: [string, string][]): HTMLElement =>
      element("dl", { class: kind }, ...rows.flatMap(([key, name]) => field(key, name)));
    this.side = element(
      "section",
      { class: "box side", "aria-label": "State of the mapper" },
      element("h2", {}, "Map"),
      list("", ["splats", "Splats shown"], ["keyframes", "Keyframes"], ["scale", "Scale"], ["revision", "Revision"]),
      element("h2", { class: "live" }, "Frames"),
      list("live", ["submaps", "Submaps"], ["received", "Received"], ["tracked", "Tracked"], ["lost", "Without a pose"], ["dropped", "Dropped"], ["uncertain", "Position, 1 σ"]),
      element("h2", { class: "live" }, "Work"),
      element("div", { class: "live" }, this.charts.latency.canvas, this.charts.steps.canvas, this.charts.splats.canvas, this.charts.memory.canvas),
      this.warnings,
    );
    this.note = element("div", { class: "box note", role: "alert" });
    this.setLink("connecting", "");
  }

  setWelcome(welcome: Welcome): void {
    this.isLive = welcome.source === "live";
    this.side.classList.toggle("still", !this.isLive);
    this.title.textContent = welcome.title || welcome.server;
    this.title.title = `${welcome.title} (${welcome.server})`;
    document.title = `${welcome.title || "map"} – splat-mapper`;
    this.showState();
  }

  setLink(link: LinkState, reason: string): void {
    this.link = link;
    this.showState();
    if (link === "lost") {
      this.say("The connection is lost", "The mapper has ended or cannot be reached. What is shown stays; the page tries again by itself.");
    } else if (link === "refused") {
      this.say("The server closed the connection", `${reason}. The page tries again by itself.`);
    } else if (link === "connecting") {
      this.say("Connecting", "");
    }
  }

  /// Words over an empty view, or none.
  say(title: string, text: string): void {
    this.note.replaceChildren(element("strong", {}, title), text);
    show(this.note, title !== "");
  }

  setMap(facts: MapFacts, nShown: number, nKeyframes: number): void {
    this.set("splats", nShown < facts.n_splats ? `${readable(nShown)} of ${readable(facts.n_splats)}` : readable(nShown));
    this.set("keyframes", readable(nKeyframes));
    this.set("revision", `${facts.revision} (epoch ${facts.epoch})`);
    const metres = facts.metres_per_unit;
    this.set("scale", metres === null ? "unknown: relative lengths" : `metres (${facts.scale_source.replaceAll("_", " ")})`);
    this.charts.splats.add(nShown);
    if (this.link === "open") {
      if (facts.n_splats > 0) {
        this.say("", "");
      } else {
        this.say("No map yet", "Move the camera sideways past things with texture.");
      }
    }
  }

  setPose(pose: TrackedPose, unit: string): void {
    this.state = pose.state;
    this.reason.textContent = pose.reason ?? "";
    const std = pose.std_m;
    this.set("uncertain", std ? readable(Math.hypot(...std) * (unit === "m" ? 1000 : 1), unit === "m" ? 1 : 4, unit === "m" ? "mm" : unit) : "–");
    this.showState();
  }

  setStatus(status: Status): void {
    this.state = status.state;
    this.reason.textContent = status.reason;
    const rows: [string, string][] = [
      ["received", "frames_received"],
      ["tracked", "frames_tracked"],
      ["lost", "frames_lost"],
      ["dropped", "frames_dropped"],
      ["submaps", "submaps"],
    ];
    rows.forEach(([key, field]) => this.set(key, readable(status[field])));
    this.charts.steps.add(status["steps_per_s"]);
    this.charts.latency.add(status["frame_to_pose_p95_ms"]);
    this.charts.memory.add(status["rss_mib"]);
    this.warnings.replaceChildren(...status.warnings.map((text) => element("li", {}, text)));
    this.showState();
  }

  private set(key: string, text: string): void {
    const field = this.fields.get(key);
    if (field) {
      field.textContent = text;
    }
  }

  private showState(): void {
    const ofLink: Record<LinkState, [string, string]> = {
      connecting: ["Connecting", "warn"],
      lost: ["Connection lost", "bad"],
      refused: ["Closed by the server", "bad"],
      open: this.isLive || this.state ? (STATES[this.state] ?? ["Connected", "good"]) : ["Saved map", "good"],
    };
    const [text, kind] = ofLink[this.link];
    if (this.chip.textContent !== text) {
      this.chip.textContent = text;
    }
    this.chip.className = `chip ${kind}`;
  }
}
