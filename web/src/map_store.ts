// The splats that the page holds, by chunk, in the arrays that they are drawn from.

import { type Hash, HashSum, sum } from "./hash";
import { type ChunkUpdate, RECORD_WORDS, SH_WORDS, type Vec3 } from "./wire";

/// Splats of a row of the textures that they are drawn from.
const ROW = 2048;

const bits = new DataView(new ArrayBuffer(4));

function bitsOf(value: number): number {
  bits.setFloat32(0, value);
  return bits.getUint32(0);
}

export class Chunk {
  n = 0;
  capacity = 0;
  origin: Vec3 = [0, 0, 0];
  ids = new Uint32Array(0);
  records = new Uint32Array(0);
  harmonics: Uint32Array[] = [];
  /// Something is drawn otherwise than it is held.
  isDirty = true;
  /// The arrays are others than they were.
  hasGrown = true;
  private readonly slots = new Map<number, number>();
  private readonly hashes = new HashSum();

  constructor(
    readonly key: number,
    readonly degree: number,
  ) {}

  /// Of the splats and of the origin.
  hash(): Hash {
    const own = new HashSum();
    own.begin();
    own.word(this.key);
    for (const value of this.origin) {
      own.word(bitsOf(value));
    }
    own.add();
    return sum([own.value(), this.hashes.value()]);
  }

  clear(): void {
    this.n = 0;
    this.slots.clear();
    this.hashes.clear();
    this.isDirty = true;
  }

  reserve(n: number): void {
    if (n <= this.capacity) {
      return;
    }
    this.capacity = Math.ceil(Math.max(n, 1.5 * this.capacity) / ROW) * ROW;
    const grown = (old: Uint32Array | undefined, words: number): Uint32Array<ArrayBuffer> => {
      const array = new Uint32Array(this.capacity * words);
      if (old) {
        array.set(old);
      }
      return array;
    };
    this.ids = grown(this.ids, 1);
    this.records = grown(this.records, RECORD_WORDS);
    this.harmonics = SH_WORDS.slice(0, this.degree).map((words, k) => grown(this.harmonics[k], words));
    this.hasGrown = true;
  }

  put(update: ChunkUpdate, at: number): void {
    const id = update.ids[at] ?? 0;
    let slot = this.slots.get(id);
    if (slot === undefined) {
      this.reserve(this.n + 1);
      slot = this.n++;
      this.slots.set(id, slot);
      this.ids[slot] = id;
    } else {
      this.hashSlot(slot);
      this.hashes.subtract();
    }
    const copy = (from: Uint32Array | undefined, to: Uint32Array | undefined, words: number): void => {
      for (let k = 0; k < words && from && to; k++) {
        to[(slot as number) * words + k] = from[at * words + k] ?? 0;
      }
    };
    copy(update.records, this.records, RECORD_WORDS);
    SH_WORDS.forEach((words, k) => copy(update.harmonics[k], this.harmonics[k], words));
    this.hashSlot(slot);
    this.hashes.add();
    this.isDirty = true;
  }

  remove(id: number): void {
    const slot = this.slots.get(id);
    if (slot === undefined) {
      return;
    }
    this.hashSlot(slot);
    this.hashes.subtract();
    this.slots.delete(id);
    const last = --this.n;
    if (slot !== last) {
      const moved = this.ids[last] ?? 0;
      this.ids[slot] = moved;
      this.slots.set(moved, slot);
      const move = (array: Uint32Array | undefined, words: number): void =>
        void array?.copyWithin(slot * words, last * words, (last + 1) * words);
      move(this.records, RECORD_WORDS);
      SH_WORDS.forEach((words, k) => move(this.harmonics[k], words));
    }
    this.isDirty = true;
  }

  private hashSlot(slot: number): void {
    const sumOf = this.hashes;
    sumOf.begin();
    sumOf.word(this.ids[slot] ?? 0);
    const take = (array: Uint32Array | undefined, words: number): void => {
      for (let k = 0; k < words && array; k++) {
        sumOf.word(array[slot * words + k] ?? 0);
      }
    };
    take(this.records, RECORD_WORDS);
    SH_WORDS.forEach((words, k) => take(this.harmonics[k], words));
  }
}

export class MapStore {
  readonly chunks = new Map<number, Chunk>();

  clear(): void {
    this.chunks.clear();
  }

  nSplats(): number {
    let n = 0;
    for (const chunk of this.chunks.values()) {
      n += chunk.n;
    }
    return n;
  }

  hash(): Hash {
    return sum([...this.chunks.values()].map((chunk) => chunk.hash()));
  }

  /// For a server that the page comes back to.
  summary(): [number, number, number, number][] {
    return [...this.chunks.values()].map((chunk) => [chunk.key, chunk.n, ...chunk.hash()]);
  }

  ids(): Uint32Array {
    const ids = new Uint32Array(this.nSplats());
    let at = 0;
    for (const chunk of this.chunks.values()) {
      ids.set(chunk.ids.subarray(0, chunk.n), at);
      at += chunk.n;
    }
    return ids.sort();
  }

  /// The chunk that an update is for; splats are put into it one after the other, so that the caller may pause.
  begin(update: ChunkUpdate): Chunk {
    let chunk = this.chunks.get(update.key);
    if (!chunk || chunk.degree !== update.degree) {
      chunk = new Chunk(update.key, update.degree);
      this.chunks.set(update.key, chunk);
    }
    if (update.begins) {
      chunk.clear();
    }
    chunk.origin = update.origin;
    for (const id of update.removed) {
      chunk.remove(id);
    }
    chunk.reserve(chunk.n + update.ids.length);
    return chunk;
  }
}
