// The page: model, world and controls tied together.

import * as THREE from "three";

import { Cameras, type CameraMode } from "./cameras";
import { Connection } from "./connection";
import { button, element, readable, show } from "./dom";
import { embedded } from "./embedded";
import { KeyframeView } from "./keyframe_view";
import { Model, type Watcher } from "./model";
import { Overlays } from "./overlays";
import { Panel } from "./panel";
import { Tape } from "./tape";
import type { Correction, Keyframe, MapFacts, Pose } from "./wire";
import { PROTOCOL } from "./wire";
import { World, matrixOf, type Pinhole } from "./world";
import { Headset, budget } from "./xr";

/// For messages, at a time.
const SLICE_MS = 8;
const EYE_MS = 500;

export class App implements Watcher {
  readonly root = element("main", { class: "sm" });
  readonly canvas = element("canvas", { class: "view", tabindex: "0", "aria-label": "The map" });
  readonly world: World;
  readonly model: Model;
  readonly overlays: Overlays;
  readonly cameras: Cameras;
  readonly connection: Connection;
  readonly errors: string[] = [];
  readonly timings = { pageLoadedAt: performance.now(), connectedAt: 0, firstSplatsAt: 0 };
  private readonly panel = new Panel();
  private readonly tape: Tape;
  private readonly headset: Headset;
  private readonly photo: KeyframeView;
  private readonly toast = element("div", { class: "box toast hidden", role: "status" });
  private readonly help = helpBox();
  private readonly slider = element("input", { type: "range", min: "0", max: "0", value: "0", "aria-label": "Keyframe, by time" });
  private readonly sliderText = element("span", {}, "–");
  private readonly modes = new Map<CameraMode, HTMLButtonElement>();
  private isMeasuring = false;
  private chosen: number | null = null;
  /// A camera of a test: rendered as it is, without anything over it.
  private fixed: { pose: Pose; lens: Pinhole } | null = null;
  private readonly background = new THREE.Color();
  private isCalm = false;
  private isWorking = false;
  private readonly turns = new MessageChannel();
  private last = performance.now();
  private eyeAt = 0;
  private toastTimer = 0;

  constructor(place: HTMLElement) {
    place.append(this.root);
    this.root.append(this.canvas);
    this.world = new World(this.canvas);
    this.model = new Model(this);
    this.overlays = new Overlays(this.world);
    this.cameras = new Cameras(this.world, (mode) => this.showMode(mode));
    this.tape = new Tape(this.world, this.model.store);
    this.headset = new Headset(this.world, () => this.model.facts?.metres_per_unit != null);
    this.photo = new KeyframeView(() => this.choose(null));
    this.connection = new Connection(
      {
        held: () => this.model.held(),
        text: (text) => this.take(text),
        binary: (bytes) => this.take(bytes),
        link: (state, reason) => {
          if (state === "open") {
            this.timings.connectedAt = performance.now();
          }
          this.panel.setLink(state, reason);
        },
      },
      budget(),
    );
    this.root.append(this.panel.head, this.panel.side, this.bar(), this.photo.box, this.panel.note, this.toast, this.help);
    this.turns.port1.onmessage = () => this.turn();
    // On a phone the map comes first.
    show(this.panel.side, window.innerWidth > 700);
    this.setLight(matchMedia("(prefers-color-scheme: light)").matches);
    this.listen();
    new ResizeObserver(() => this.resize()).observe(this.root);
    this.resize();
    this.world.renderer.setAnimationLoop((now) => this.frame(now));
  }

  start(): void {
    const source = embedded();
    if (!source) {
      this.connection.open();
      return;
    }
    source.then(
      (messages) => {
        this.panel.setLink("open", "");
        messages.forEach((message) => this.take(message));
      },
      (error: unknown) => this.fault(error),
    );
  }

  /// Messages are read between frames, in slices: a slow picture holds them up no more than they hold up the picture.
  private take(message: string | ArrayBuffer): void {
    this.model.take(message);
    if (!this.isWorking) {
      this.isWorking = true;
      this.turns.port2.postMessage(null);
    }
  }

  private turn(): void {
    this.isWorking = !this.model.work(performance.now() + SLICE_MS);
    if (this.isWorking) {
      this.turns.port2.postMessage(null);
    }
  }

  // What the model says.

  welcome(welcome: Parameters<Watcher["welcome"]>[0]): void {
    if (welcome.protocol !== PROTOCOL) {
      this.connection.close();
      this.panel.say("Another version", `The server speaks protocol ${welcome.protocol}, this page ${PROTOCOL}: load the page again.`);
      return;
    }
    this.panel.setWelcome(welcome);
    if (welcome.source !== "live" && this.cameras.mode === "follow") {
      this.cameras.setMode("free");
    }
  }

  cleared(): void {
    this.overlays.clearTrail();
    this.choose(null);
  }

  map(facts: MapFacts): void {
    this.world.place(facts);
    this.showMap();
  }

  keyframes(moved: Map<number, Keyframe>): void {
    for (const [id, before] of moved) {
      const [chunk, now] = [this.model.store.chunks.get(id), this.model.keyframes.get(id)];
      if (chunk && now) {
        this.world.moveChunk(chunk, matrixOf(now.pose).multiply(matrixOf(before.pose).invert()));
      }
    }
    this.drawKeyframes();
    const n = this.model.keyframes.size;
    const wasLast = this.slider.value === this.slider.max;
    this.slider.max = String(Math.max(n - 1, 0));
    if (wasLast) {
      this.slider.value = this.slider.max;
      this.sliderText.textContent = n > 0 ? `all ${n}` : "–";
    }
  }

  chunkBegins(key: number): void {
    const chunk = this.model.store.chunks.get(key);
    if (chunk) {
      this.world.settle(chunk);
    }
  }

  synced(isRight: boolean): void {
    if (!isRight) {
      this.errors.push("a hash did not agree");
      this.model.forget();
      this.connection.resync();
      return;
    }
    // Keyframes that moved a little between two corrections: their splats have come one by one.
    this.model.store.chunks.forEach((chunk) => this.world.settle(chunk));
    this.showMap();
  }

  pose(pose: Parameters<Watcher["pose"]>[0]): void {
    const metres = this.model.facts?.metres_per_unit ?? null;
    const keyframes = this.sorted();
    this.overlays.setNow(pose, metres ?? 1, this.overlays.size(keyframes.slice(-50)), keyframes[keyframes.length - 1]);
    this.panel.setPose(pose, metres === null ? "units" : "m");
    if (pose.pose) {
      this.cameras.follow(pose.pose);
    }
  }

  status(status: Parameters<Watcher["status"]>[0]): void {
    this.panel.setStatus(status);
  }

  correction(correction: Correction): void {
    const words: Record<string, string> = {
      loop: "Loop closed",
      merge: "Two submaps joined",
      reset: "The map was thrown away",
      loaded: "A saved map was loaded",
      renumbered: "Splats have new ids",
    };
    const metres = this.model.facts?.metres_per_unit ?? null;
    const far = readable(correction.moved * (metres ?? 1), 2, metres === null ? "units" : "m");
    const turn = readable((correction.rotation_rad * 180) / Math.PI, 1, "°");
    this.say(`${words[correction.reason] ?? "The map has moved"}: the newest keyframe moved ${far}, turned ${turn}`);
    this.overlays.flash(this.model.keyframes.keys());
    this.overlays.clearTrail();
    this.drawKeyframes();
  }

  path(path: Parameters<Watcher["path"]>[0]): void {
    this.overlays.setPath(path);
  }

  grid(grid: Parameters<Watcher["grid"]>[0]): void {
    this.overlays.setGrid(grid).catch((error: unknown) => this.fault(error));
  }

  bye(reason: string): void {
    this.connection.bye(reason);
  }

  fault(error: unknown): void {
    this.errors.push(String(error));
    this.say(`A message could not be read: ${String(error)}`);
  }

  // For tests and for reports.

  setPose(pose: Pose | null, lens?: Pinhole): void {
    this.fixed = pose && lens ? { pose, lens } : null;
    this.root.classList.toggle("plain", this.fixed !== null);
    this.overlays.group.visible = this.fixed === null;
    this.overlays.showGrids(this.fixed !== null);
    this.world.scene.background = this.fixed ? new THREE.Color(0) : this.background;
    if (this.fixed) {
      this.world.renderer.setPixelRatio(1);
      this.world.renderer.setSize(this.fixed.lens.width, this.fixed.lens.height, false);
    } else {
      this.world.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
      this.world.camera.updateProjectionMatrix();
      this.resize();
    }
  }

  /// Resolves once all that is held is drawn, in the order that the camera asks for.
  async settled(): Promise<void> {
    for (let calm = 0; calm < 3; ) {
      await new Promise((done) => requestAnimationFrame(done));
      calm = this.isCalm ? calm + 1 : 0;
    }
  }

  private frame(now: number): void {
    const seconds = Math.min((now - this.last) / 1000, 0.1);
    this.last = now;
    if (this.world.isHolding()) {
      this.isCalm &&= !this.isWorking && !this.world.isSorting();
      return;
    }
    const isUploaded = this.world.upload(this.model.store);
    if (this.timings.firstSplatsAt === 0 && this.model.store.nSplats() > 0) {
      this.timings.firstSplatsAt = performance.now();
    }
    if (this.overlays.flashHasEnded()) {
      this.drawKeyframes();
    }
    if (this.world.renderer.xr.isPresenting) {
      this.headset.update();
    } else if (this.fixed) {
      this.world.lookThrough(this.fixed.pose, this.fixed.lens);
    } else {
      this.cameras.update(seconds);
    }
    if (now - this.eyeAt > EYE_MS) {
      this.eyeAt = now;
      this.connection.eye(this.world.eye());
    }
    this.world.render();
    this.isCalm = !this.isWorking && isUploaded && !this.world.isSorting();
  }

  private sorted(): Keyframe[] {
    return [...this.model.keyframes.values()].sort((a, b) => a.id - b.id);
  }

  private drawKeyframes(): void {
    const keyframes = this.sorted();
    const metres = this.model.facts?.scale ?? 1;
    this.cameras.size = Math.max(this.overlays.size(keyframes) * 6 * metres, 0.05);
    this.overlays.setKeyframes(keyframes, this.chosen);
    const first = keyframes[0];
    if (first && this.chosen === null && this.cameras.mode === "free" && this.model.facts && !this.hasLooked) {
      this.hasLooked = true;
      this.cameras.flyTo(first.pose);
    }
  }

  private hasLooked = false;

  private showMap(): void {
    if (this.model.facts) {
      this.panel.setMap(this.model.facts, this.model.store.nSplats(), this.model.keyframes.size);
    }
  }

  private say(text: string): void {
    this.toast.textContent = text;
    show(this.toast, true);
    window.clearTimeout(this.toastTimer);
    this.toastTimer = window.setTimeout(() => show(this.toast, false), 6000);
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.root;
    if (!this.fixed && clientWidth > 0 && clientHeight > 0) {
      this.world.resize(clientWidth, clientHeight);
    }
  }

  private bar(): HTMLElement {
    const mode = (of: CameraMode, name: string): HTMLButtonElement => {
      const made = button(`${name} camera`, name, () => this.cameras.setMode(of));
      this.modes.set(of, made);
      return made;
    };
    const measure = button("Measure a distance", "Tape", () => {
      this.isMeasuring = !this.isMeasuring;
      measure.setAttribute("aria-pressed", String(this.isMeasuring));
      this.tape.clear();
      this.say(this.isMeasuring ? "Click two places on surfaces" : "");
      show(this.toast, this.isMeasuring);
    });
    this.slider.addEventListener("input", () => this.slide());
    const extra = element("span", { class: "group" });
    void this.headset.offer(extra);
    const bar = element(
      "footer",
      { class: "box bar", "aria-label": "Controls" },
      element("span", { class: "group", role: "group", "aria-label": "Camera" }, mode("follow", "Follow"), mode("free", "Free"), mode("walk", "Walk")),
      element("span", { class: "grow" }, this.slider, this.sliderText),
      measure,
      button("Save a screenshot", "Screenshot", () => this.screenshot()),
      button("Light or dark", "Theme", () => this.setLight(!this.root.classList.contains("light"))),
      button("Show the grid of free and occupied ground or not", "Grid", () => this.overlays.toggleGrids()),
      button("Show the state panel or not", "Panel", () => this.panel.side.classList.toggle("hidden")),
      button("Keys", "?", () => this.help.classList.toggle("hidden")),
      extra,
    );
    this.showMode(this.cameras.mode);
    return bar;
  }

  private showMode(mode: CameraMode): void {
    this.modes.forEach((made, of) => made.setAttribute("aria-pressed", String(of === mode)));
  }

  private setLight(isLight: boolean): void {
    this.root.classList.toggle("light", isLight);
    this.background.set(isLight ? 0xe3e7ee : 0x0c0e12);
    this.world.scene.background = this.background;
  }

  /// The time slider: the map as far as it hangs on keyframes up to one.
  private slide(): void {
    const keyframes = this.sorted();
    const at = Number(this.slider.value);
    const isLast = at >= keyframes.length - 1;
    const keyframe = keyframes[at];
    this.world.showUpTo(isLast || !keyframe ? null : keyframe.id);
    if (keyframe) {
      this.sliderText.textContent = isLast ? `all ${keyframes.length}` : `${at + 1} of ${keyframes.length}`;
      this.cameras.flyTo(keyframe.pose);
    }
  }

  private choose(keyframe: Keyframe | null): void {
    this.chosen = keyframe?.id ?? null;
    this.drawKeyframes();
    if (!keyframe) {
      this.photo.hide();
      return;
    }
    this.cameras.flyTo(keyframe.pose);
    this.photo.open(keyframe, (into) => window.setTimeout(() => this.copyView(keyframe, into), 1200));
  }

  /// The map through the keyframe's lens, into a small canvas.
  private copyView(keyframe: Keyframe, into: HTMLCanvasElement): void {
    const share = 480 / Math.max(keyframe.width, keyframe.height);
    const of = (value: number): number => value * share;
    const lens: Pinhole = {
      width: Math.round(of(keyframe.width)),
      height: Math.round(of(keyframe.height)),
      fx: of(keyframe.fx),
      fy: of(keyframe.fy),
      cx: of(keyframe.cx),
      cy: of(keyframe.cy),
    };
    this.setPose(keyframe.pose, lens);
    this.root.classList.remove("plain");
    this.world.lookThrough(keyframe.pose, lens);
    this.world.render();
    into.width = lens.width;
    into.height = lens.height;
    into.getContext("2d")?.drawImage(this.canvas, 0, 0);
    this.setPose(null);
  }

  private screenshot(): void {
    this.world.render();
    this.canvas.toBlob((blob) => {
      if (blob) {
        const link = element("a", { href: URL.createObjectURL(blob), download: "splat-mapper.png" });
        link.click();
        URL.revokeObjectURL(link.href);
      }
    });
  }

  private listen(): void {
    let down = { x: 0, y: 0 };
    this.canvas.addEventListener("pointerdown", (event) => {
      down = { x: event.clientX, y: event.clientY };
    });
    this.canvas.addEventListener("pointerup", (event) => {
      if (Math.hypot(event.clientX - down.x, event.clientY - down.y) < 5) {
        void this.click(event);
      }
    });
    window.addEventListener("keydown", (event) => this.key(event));
  }

  private async click(event: PointerEvent): Promise<void> {
    const place = this.canvas.getBoundingClientRect();
    const x = ((event.clientX - place.left) / place.width) * 2 - 1;
    const y = 1 - ((event.clientY - place.top) / place.height) * 2;
    if (!this.isMeasuring) {
      const found = this.nearestKeyframe(x, y);
      if (found) {
        this.choose(found);
      }
      return;
    }
    const units = await this.tape.click(x, y);
    if (units === undefined) {
      this.say("Nothing solid there: click on a surface");
    } else if (units !== null) {
      const metres = this.model.facts?.metres_per_unit ?? null;
      this.say(metres === null ? `${readable(units, 3)} units (the scale is not known)` : readable(units * metres, 3, "m"));
    }
  }

  /// The keyframe whose camera is drawn nearest to a place of the view, if it is near.
  private nearestKeyframe(x: number, y: number): Keyframe | null {
    let [best, bestDistance] = [null as Keyframe | null, 0.04];
    for (const keyframe of this.model.keyframes.values()) {
      const [, , , , tx, ty, tz] = keyframe.pose;
      const at = new THREE.Vector3(tx, ty, tz).applyMatrix4(this.world.splatFrame.matrixWorld).project(this.world.camera);
      const distance = Math.hypot((at.x - x) * this.world.camera.aspect, at.y - y);
      if (at.z < 1 && distance < bestDistance) {
        [best, bestDistance] = [keyframe, distance];
      }
    }
    return best;
  }

  private key(event: KeyboardEvent): void {
    if (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey) {
      return;
    }
    const actions: Record<string, () => void> = {
      "1": () => this.cameras.setMode("follow"),
      "2": () => this.cameras.setMode("free"),
      "3": () => this.cameras.setMode("walk"),
      p: () => this.screenshot(),
      o: () => {
        this.overlays.group.visible = !this.overlays.group.visible;
      },
      g: () => this.overlays.toggleGrids(),
      "?": () => this.help.classList.toggle("hidden"),
      Escape: () => this.choose(null),
    };
    actions[event.key]?.();
  }
}

function helpBox(): HTMLElement {
  const keys: [string, string][] = [
    ["1 2 3", "follow the camera, free, walk"],
    ["W A S D Q E", "walk, down and up; Shift for speed"],
    ["drag, wheel, two fingers", "turn, move, zoom"],
    ["click on a keyframe", "fly there and see its photo"],
    ["O", "lines and cameras on or off"],
    ["G", "free and occupied ground on or off"],
    ["P", "screenshot"],
    ["Esc", "close the photo"],
  ];
  const rows = keys.flatMap(([key, text]) => [element("dt", {}, element("kbd", {}, key)), element("dd", {}, text)]);
  return element("section", { class: "box help hidden", "aria-label": "Keys" }, element("dl", {}, ...rows));
}
