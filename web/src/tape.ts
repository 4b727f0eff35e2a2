// The measuring tape: two clicks on surfaces, and the distance between them.

import * as THREE from "three";

import type { MapStore } from "./map_store";
import { COLOURS } from "./overlays";
import type { World } from "./world";

/// Splats that are more transparent are no surface.
const MIN_ALPHA = 0.3 * 255;
/// Half angle of the cone round the click in which splats count, rad.
const CONE = 0.012;
/// Splats that are looked at before the page is let go on.
const SLICE = 150000;

function half(bits: number): number {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const share = bits & 1023;
  if (exponent === 0) {
    return sign * share * 2 ** -24;
  }
  return exponent === 31 ? Number.NaN : sign * (1 + share / 1024) * 2 ** (exponent - 15);
}

export class Tape {
  private readonly points: THREE.Vector3[] = [];
  private readonly line: THREE.Line;
  private readonly dots: THREE.Points;

  constructor(
    private readonly world: World,
    private readonly store: MapStore,
  ) {
    const material = { color: COLOURS.plan, depthTest: false, transparent: true };
    this.line = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial(material));
    this.dots = new THREE.Points(new THREE.BufferGeometry(), new THREE.PointsMaterial({ ...material, size: 9, sizeAttenuation: false }));
    for (const object of [this.line, this.dots]) {
      object.frustumCulled = false;
      object.renderOrder = 11;
      world.splatFrame.add(object);
    }
  }

  clear(): void {
    this.points.length = 0;
    this.draw();
  }

  /// A click at -1..1 -> the distance in units of the splat frame once there are two points; null before, undefined where nothing was hit.
  async click(x: number, y: number): Promise<number | null | undefined> {
    const found = await this.pick(x, y);
    if (!found) {
      return undefined;
    }
    if (this.points.length === 2) {
      this.points.length = 0;
    }
    this.points.push(found);
    this.draw();
    const [a, b] = this.points;
    return a && b ? a.distanceTo(b) : null;
  }

  /// The nearest solid splat of those close to the ray.
  private async pick(x: number, y: number): Promise<THREE.Vector3 | null> {
    const caster = new THREE.Raycaster();
    caster.setFromCamera(new THREE.Vector2(x, y), this.world.camera);
    const inverse = this.world.splatFrame.matrixWorld.clone().invert();
    const from = caster.ray.origin.clone().applyMatrix4(inverse);
    const ahead = caster.ray.direction.clone().transformDirection(inverse);
    const point = new THREE.Vector3();
    let [best, bestDepth, seen] = [null as THREE.Vector3 | null, Number.POSITIVE_INFINITY, 0];
    for (const chunk of this.store.chunks.values()) {
      const [ox, oy, oz] = chunk.origin;
      for (let k = 0; k < chunk.n; k++) {
        const [w0, w1, w2] = [chunk.records[4 * k] ?? 0, chunk.records[4 * k + 1] ?? 0, chunk.records[4 * k + 2] ?? 0];
        if (w0 >>> 24 < MIN_ALPHA) {
          continue;
        }
        point.set(ox + half(w1 & 0xffff), oy + half(w1 >>> 16), oz + half(w2 & 0xffff)).sub(from);
        const depth = point.dot(ahead);
        if (depth > 0 && depth < bestDepth && point.lengthSq() < depth * depth * (1 + CONE * CONE)) {
          bestDepth = depth;
          best = point.clone().add(from);
        }
      }
      seen += chunk.n;
      if (seen > SLICE) {
        seen = 0;
        await new Promise((done) => setTimeout(done));
      }
    }
    return best;
  }

  private draw(): void {
    const points = this.points.flatMap((point) => point.toArray());
    for (const object of [this.line, this.dots]) {
      object.geometry.dispose();
      object.geometry = new THREE.BufferGeometry();
      object.geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
    }
  }
}
