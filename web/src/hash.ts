// Sums that say whether the page holds the splats that the server sent (docs/VIEWER.md, "Hashes").

export type Hash = [number, number];

const SEEDS: Hash = [0x811c9dc5, 0x9e3779b9];

function step(x: number, word: number): number {
  const y = Math.imul(x ^ word, 0x01000193);
  return y ^ (y >>> 15);
}

function mixed(x: number): number {
  let y = Math.imul(x ^ (x >>> 16), 0x85ebca6b);
  y = Math.imul(y ^ (y >>> 13), 0xc2b2ae35);
  return y ^ (y >>> 16);
}

/// Takes the words of one splat, its id first, and adds to a sum.
export class HashSum {
  private a = 0;
  private b = 0;
  private x: Hash = [0, 0];

  begin(): void {
    this.x[0] = SEEDS[0];
    this.x[1] = SEEDS[1];
  }

  word(word: number): void {
    this.x[0] = step(this.x[0], word);
    this.x[1] = step(this.x[1], word);
  }

  add(): void {
    this.a = (this.a + mixed(this.x[0])) | 0;
    this.b = (this.b + mixed(this.x[1])) | 0;
  }

  subtract(): void {
    this.a = (this.a - mixed(this.x[0])) | 0;
    this.b = (this.b - mixed(this.x[1])) | 0;
  }

  clear(): void {
    this.a = 0;
    this.b = 0;
  }

  value(): Hash {
    return [this.a >>> 0, this.b >>> 0];
  }
}

export function sum(all: Iterable<Hash>): Hash {
  let [a, b] = [0, 0];
  for (const hash of all) {
    a = (a + hash[0]) | 0;
    b = (b + hash[1]) | 0;
  }
  return [a >>> 0, b >>> 0];
}
