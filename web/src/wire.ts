// The messages of docs/VIEWER.md, read with care: what comes from outside is believed only as far as it reaches.

import type { Hash } from "./hash";

export const PROTOCOL = 1;
/// Words of a splat's record, and of its spherical harmonics of degrees 1, 2 and 3.
export const RECORD_WORDS = 4;
export const SH_WORDS = [2, 4, 4] as const;

/// qx, qy, qz, qw, tx, ty, tz: takes points of the camera to the splat frame.
export type Pose = [number, number, number, number, number, number, number];
export type Vec3 = [number, number, number];

export interface Welcome {
  type: "welcome";
  protocol: number;
  server: string;
  source: "live" | "map" | "recording";
  title: string;
}

export interface MapFacts {
  type: "map";
  map_id: string;
  epoch: number;
  revision: number;
  sh_degree: number;
  n_splats: number;
  metres_per_unit: number | null;
  scale_source: string;
  rotation: [number, number, number, number];
  translation: Vec3;
  scale: number;
}

export interface Keyframes {
  type: "keyframes";
  keyframes: number[][];
  removed: number[];
}

export interface Synced {
  type: "synced";
  epoch: number;
  revision: number;
  n_splats: number;
  hash: Hash;
}

export interface TrackedPose {
  type: "pose";
  stamp: number;
  pose: Pose | null;
  std_m?: Vec3;
  std_rad?: Vec3;
  state: string;
  reason: string | null;
}

/// Fields of splat_mapper_msgs/MapperStatus by their names; numbers that are not known are null.
export interface Status {
  type: "status";
  state: string;
  reason: string;
  warnings: string[];
  [field: string]: unknown;
}

export interface Correction {
  type: "correction";
  reason: string;
  moved: number;
  rotation_rad: number;
}

export interface PathOverlay {
  type: "path";
  name: string;
  points: Vec3[];
}

export interface GridOverlay {
  type: "grid";
  name: string;
  rotation: [number, number, number, number];
  translation: Vec3;
  resolution: number;
  width: number;
  height: number;
  png: string;
}

export type Said =
  | Welcome
  | MapFacts
  | Keyframes
  | { type: "drop"; chunks: number[] }
  | Synced
  | TrackedPose
  | Status
  | Correction
  | PathOverlay
  | GridOverlay
  | { type: "bye"; reason: string };

export interface Keyframe {
  id: number;
  stamp: number;
  pose: Pose;
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
}

/// What one binary message changes.
export interface ChunkUpdate {
  degree: number;
  begins: boolean;
  key: number;
  epoch: number;
  origin: Vec3;
  ids: Uint32Array;
  records: Uint32Array;
  /// By degree, the first for degree 1.
  harmonics: Uint32Array[];
  removed: Uint32Array;
}

export function parseText(text: string): Said {
  const said: unknown = JSON.parse(text);
  if (typeof said !== "object" || said === null || typeof (said as Said).type !== "string") {
    throw new Error("a message without a type");
  }
  return said as Said;
}

export function keyframeOf(row: number[]): Keyframe {
  if (row.length !== 15 || !row.every(Number.isFinite)) {
    throw new Error("a keyframe with other than 15 numbers");
  }
  const at = (k: number): number => row[k] ?? 0;
  return {
    id: at(0),
    stamp: at(1),
    pose: row.slice(2, 9) as Pose,
    width: at(9),
    height: at(10),
    fx: at(11),
    fy: at(12),
    cx: at(13),
    cy: at(14),
  };
}

export function parseChunk(bytes: ArrayBuffer): ChunkUpdate {
  const HEADER = 32;
  if (bytes.byteLength < HEADER || bytes.byteLength % 4 !== 0) {
    throw new Error(`a chunk of ${bytes.byteLength} bytes`);
  }
  const view = new DataView(bytes);
  const degree = view.getUint8(1);
  if (view.getUint8(0) !== 1 || degree > 3) {
    throw new Error("a binary message that is no chunk");
  }
  const n = view.getUint32(12, true);
  const m = view.getUint32(16, true);
  const shWords = SH_WORDS.slice(0, degree);
  const perSplat = 1 + RECORD_WORDS + shWords.reduce((all, words) => all + words, 0);
  // No more is taken than is there.
  if (HEADER + 4 * (n * perSplat + m) !== bytes.byteLength) {
    throw new Error(`a chunk of ${n} splats in ${bytes.byteLength} bytes`);
  }
  let at = HEADER;
  const words = (count: number): Uint32Array => {
    const found = new Uint32Array(bytes, at, count);
    at += 4 * count;
    return found;
  };
  return {
    degree,
    begins: (view.getUint16(2, true) & 1) === 1,
    key: view.getUint32(4, true),
    epoch: view.getUint32(8, true),
    origin: [view.getFloat32(20, true), view.getFloat32(24, true), view.getFloat32(28, true)],
    ids: words(n),
    records: words(n * RECORD_WORDS),
    harmonics: shWords.map((count) => words(n * count)),
    removed: words(m),
  };
}
