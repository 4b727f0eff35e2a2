// What the page knows: takes messages in, in slices, and says what has changed.

import { MapStore } from "./map_store";
import {
  type ChunkUpdate,
  type Correction,
  type GridOverlay,
  type Keyframe,
  type MapFacts,
  type PathOverlay,
  type Said,
  type Status,
  type Synced,
  type TrackedPose,
  type Welcome,
  keyframeOf,
  parseChunk,
  parseText,
} from "./wire";

/// Splats that are put in before the clock is looked at.
const SLICE = 512;

export interface Watcher {
  welcome(welcome: Welcome): void;
  /// Another map: all that was held is gone.
  cleared(): void;
  map(facts: MapFacts): void;
  keyframes(moved: Map<number, Keyframe>): void;
  /// A chunk lies where its splats say from now on.
  chunkBegins(key: number): void;
  synced(isRight: boolean): void;
  pose(pose: TrackedPose): void;
  status(status: Status): void;
  correction(correction: Correction): void;
  path(path: PathOverlay): void;
  grid(grid: GridOverlay): void;
  bye(reason: string): void;
  fault(error: unknown): void;
}

export class Model {
  readonly store = new MapStore();
  readonly keyframes = new Map<number, Keyframe>();
  facts: MapFacts | null = null;
  synced: Synced | null = null;
  tracked: TrackedPose | null = null;
  private queue: (string | ArrayBuffer)[] = [];
  private update: { chunk: ChunkUpdate; at: number } | null = null;
  /// A message could not be read, or a splat is held otherwise than the server says: the next `synced` is not believed.
  private isBroken = false;

  constructor(private readonly watcher: Watcher) {}

  take(message: string | ArrayBuffer): void {
    this.queue.push(message);
  }

  /// Works until `deadline` (performance.now); false where messages wait.
  work(deadline: number): boolean {
    while (this.update || this.queue.length > 0) {
      if (performance.now() >= deadline) {
        return false;
      }
      try {
        this.step();
      } catch (error) {
        this.update = null;
        this.isBroken = true;
        this.watcher.fault(error);
      }
    }
    return true;
  }

  /// For a new connection: nothing of the old one waits.
  held(): { map_id: string; epoch: number; chunks: [number, number, number, number][] } {
    this.work(Number.POSITIVE_INFINITY);
    this.isBroken = false;
    return { map_id: this.facts?.map_id ?? "", epoch: this.facts?.epoch ?? 0, chunks: this.store.summary() };
  }

  forget(): void {
    this.queue = [];
    this.update = null;
    this.isBroken = false;
    this.store.clear();
  }

  private step(): void {
    if (this.update) {
      const { chunk } = this.update;
      const held = this.store.chunks.get(chunk.key);
      const to = Math.min(this.update.at + SLICE, chunk.ids.length);
      for (let at = this.update.at; at < to && held; at++) {
        held.put(chunk, at);
      }
      this.update.at = to;
      if (to === chunk.ids.length) {
        this.update = null;
      }
      return;
    }
    const message = this.queue.shift();
    if (typeof message === "string") {
      this.hear(parseText(message));
    } else if (message) {
      const chunk = parseChunk(message);
      this.store.begin(chunk);
      if (chunk.begins) {
        this.watcher.chunkBegins(chunk.key);
      }
      this.update = { chunk, at: 0 };
    }
  }

  private hear(said: Said): void {
    const watcher = this.watcher;
    switch (said.type) {
      case "welcome":
        return watcher.welcome(said);
      case "map":
        if (this.facts && this.facts.map_id !== said.map_id) {
          this.store.clear();
          this.keyframes.clear();
          watcher.cleared();
        }
        this.facts = said;
        return watcher.map(said);
      case "keyframes":
        return this.hearKeyframes(said.keyframes, said.removed);
      case "drop":
        said.chunks.forEach((key) => this.store.chunks.delete(key));
        return;
      case "synced":
        return this.check(said);
      case "pose":
        this.tracked = said;
        return watcher.pose(said);
      case "status":
        return watcher.status(said);
      case "correction":
        return watcher.correction(said);
      case "path":
        return watcher.path(said);
      case "grid":
        return watcher.grid(said);
      case "bye":
        return watcher.bye(said.reason);
      default:
        throw new Error("a message of an unknown type");
    }
  }

  private hearKeyframes(rows: number[][], removed: number[]): void {
    const moved = new Map<number, Keyframe>();
    for (const row of rows) {
      const keyframe = keyframeOf(row);
      const before = this.keyframes.get(keyframe.id);
      if (before) {
        moved.set(keyframe.id, before);
      }
      this.keyframes.set(keyframe.id, keyframe);
    }
    removed.forEach((id) => this.keyframes.delete(id));
    this.watcher.keyframes(moved);
  }

  private check(said: Synced): void {
    const [a, b] = this.store.hash();
    const isRight = !this.isBroken && a === said.hash[0] && b === said.hash[1] && this.store.nSplats() === said.n_splats;
    if (isRight) {
      this.synced = said;
    }
    this.watcher.synced(isRight);
  }
}
