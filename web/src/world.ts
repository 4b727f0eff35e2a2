// What is drawn: a splat mesh for each chunk below one group that stands for the splat frame.

import { PackedSplats, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";

import type { Chunk, MapStore } from "./map_store";
import { Pacing } from "./pacing";
import type { MapFacts, Pose } from "./wire";

/// Bytes that go to the GPU in a frame.
const UPLOAD_BYTES = 4 << 20;
/// Colours 0 to 255 stand for these, and scales 1 to 255 for logarithms.
const ENCODING = { rgbMin: -0.5, rgbMax: 1.5, lnScaleMin: -12, lnScaleMax: 9, sh1Max: 1, sh2Max: 1, sh3Max: 1 };
/// The camera of the field looks along +z with y down, that of three along -z with y up.
const FLIP = new THREE.Matrix4().makeRotationX(Math.PI);

interface Drawn {
  packed: PackedSplats;
  mesh: SplatMesh;
  n: number;
}

interface Texture {
  value: THREE.Texture;
}

export interface Pinhole {
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
}

export function matrixOf(pose: Pose): THREE.Matrix4 {
  const [x, y, z, w, tx, ty, tz] = pose;
  const turn = new THREE.Quaternion(x, y, z, w).normalize();
  return new THREE.Matrix4().compose(new THREE.Vector3(tx, ty, tz), turn, new THREE.Vector3(1, 1, 1));
}

export class World {
  readonly renderer: THREE.WebGLRenderer;
  readonly scene = new THREE.Scene();
  readonly camera = new THREE.PerspectiveCamera(60, 1, 0.01, 2000);
  /// The robot's map frame, y up.
  readonly mapFrame = new THREE.Group();
  /// The splat frame and its unit.
  readonly splatFrame = new THREE.Group();
  readonly spark: SparkRenderer;
  private readonly pacing: Pacing;
  private readonly drawn = new Map<number, Drawn>();
  private readonly moved = new Map<number, THREE.Matrix4>();
  private readonly hidden = new Set<number>();

  constructor(readonly canvas: HTMLCanvasElement) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    // Asking for errors waits for the compiler.
    this.renderer.debug.checkShaderErrors = false;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.spark = new SparkRenderer({ renderer: this.renderer, enableLod: false, preBlurAmount: 0.3, blurAmount: 0, accumExtSplats: true, maxStdDev: 3.33, minAlpha: 1 / 255 });
    this.pacing = new Pacing(this.renderer.getContext() as WebGL2RenderingContext);
    this.scene.add(this.spark, this.mapFrame);
    // x ahead, y left, z up -> x ahead, y up, z right.
    this.mapFrame.rotation.x = -Math.PI / 2;
    this.mapFrame.add(this.splatFrame);
    this.scene.add(this.camera);
  }

  place(facts: MapFacts): void {
    const [x, y, z, w] = facts.rotation;
    this.splatFrame.quaternion.set(x, y, z, w).normalize();
    this.splatFrame.position.fromArray(facts.translation);
    this.splatFrame.scale.setScalar(facts.scale > 0 ? facts.scale : 1);
    this.scene.updateMatrixWorld(true);
  }

  resize(width: number, height: number): void {
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
  }

  /// Sends some of what has changed to the GPU; false where more waits.
  upload(store: MapStore): boolean {
    let bytes = 0;
    for (const [key, drawn] of this.drawn) {
      if (!store.chunks.has(key)) {
        this.forget(key, drawn);
      }
    }
    for (const chunk of store.chunks.values()) {
      if (!chunk.isDirty) {
        continue;
      }
      if (bytes > UPLOAD_BYTES) {
        return false;
      }
      bytes += chunk.capacity * 4 * (4 + 2 * chunk.harmonics.length);
      this.draw(chunk);
    }
    return true;
  }

  private forget(key: number, drawn: Drawn): void {
    this.splatFrame.remove(drawn.mesh);
    drawn.mesh.dispose();
    this.drawn.delete(key);
    this.moved.delete(key);
  }

  private draw(chunk: Chunk): void {
    let drawn = this.drawn.get(chunk.key);
    if (drawn && (chunk.hasGrown || drawn.n === 0)) {
      const kept = this.moved.get(chunk.key);
      this.forget(chunk.key, drawn);
      if (kept) {
        this.moved.set(chunk.key, kept);
      }
      drawn = undefined;
    }
    if (!drawn) {
      drawn = this.begin(chunk);
    }
    const { packed, mesh } = drawn;
    packed.numSplats = chunk.n;
    packed.needsUpdate = true;
    for (const k of [1, 2, 3]) {
      const texture = packed.extra[`sh${k}Texture`] as Texture | undefined;
      if (texture) {
        texture.value.needsUpdate = true;
      }
    }
    mesh.numSplats = chunk.n;
    mesh.updateVersion();
    this.setMatrix(chunk.key, chunk.origin);
    drawn.n = chunk.n;
    chunk.isDirty = false;
    chunk.hasGrown = false;
  }

  private begin(chunk: Chunk): Drawn {
    const extra: Record<string, unknown> = {};
    chunk.harmonics.forEach((array, k) => {
      extra[`sh${k + 1}`] = array;
    });
    const packed = new PackedSplats({
      packedArray: chunk.records,
      numSplats: chunk.n,
      extra,
      splatEncoding: ENCODING,
    });
    const mesh = new SplatMesh({ packedSplats: packed, raycastable: false, splatEncoding: ENCODING });
    packed.splatEncoding = ENCODING;
    mesh.visible = !this.hidden.has(chunk.key);
    this.splatFrame.add(mesh);
    const drawn = { packed, mesh, n: chunk.n };
    this.drawn.set(chunk.key, drawn);
    return drawn;
  }

  private setMatrix(key: number, origin: readonly number[]): void {
    const mesh = this.drawn.get(key)?.mesh;
    if (!mesh) {
      return;
    }
    const at = new THREE.Matrix4().makeTranslation(origin[0] ?? 0, origin[1] ?? 0, origin[2] ?? 0);
    const moved = this.moved.get(key);
    const matrix = moved ? moved.clone().multiply(at) : at;
    matrix.decompose(mesh.position, mesh.quaternion, mesh.scale);
    mesh.updateVersion();
  }

  /// A keyframe has moved, and what hangs on it with it, until the chunk begins anew.
  moveChunk(chunk: Chunk, by: THREE.Matrix4): void {
    const before = this.moved.get(chunk.key) ?? new THREE.Matrix4();
    this.moved.set(chunk.key, by.clone().multiply(before));
    this.setMatrix(chunk.key, chunk.origin);
  }

  /// The chunk lies where its splats say.
  settle(chunk: Chunk): void {
    if (this.moved.delete(chunk.key)) {
      this.setMatrix(chunk.key, chunk.origin);
    }
  }

  /// Hides chunks of keyframes later than `key`; all are shown for null.
  showUpTo(key: number | null): void {
    for (const [of, { mesh }] of this.drawn) {
      const isHidden = key !== null && of > key;
      mesh.visible = !isHidden;
      if (isHidden) {
        this.hidden.add(of);
      } else {
        this.hidden.delete(of);
      }
    }
  }

  /// How the camera of a pose in the splat frame stands in the scene.
  cameraMatrix(pose: Pose): THREE.Matrix4 {
    this.splatFrame.updateWorldMatrix(true, false);
    const matrix = this.splatFrame.matrixWorld.clone().multiply(matrixOf(pose)).multiply(FLIP);
    const [position, turn, scale] = [new THREE.Vector3(), new THREE.Quaternion(), new THREE.Vector3()];
    matrix.decompose(position, turn, scale);
    return matrix.compose(position, turn, new THREE.Vector3(1, 1, 1));
  }

  /// Looks through a camera as it is calibrated.
  lookThrough(pose: Pose, lens: Pinhole): void {
    this.cameraMatrix(pose).decompose(this.camera.position, this.camera.quaternion, this.camera.scale);
    const { near, far } = this.camera;
    const left = (-(lens.cx) / lens.fx) * near;
    const right = ((lens.width - lens.cx) / lens.fx) * near;
    const top = (lens.cy / lens.fy) * near;
    const bottom = (-(lens.height - lens.cy) / lens.fy) * near;
    this.camera.projectionMatrix.makePerspective(left, right, top, bottom, near, far);
    this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
  }

  /// Where the viewer stands, in the splat frame.
  eye(): [number, number, number] {
    const place = this.camera.getWorldPosition(new THREE.Vector3());
    this.splatFrame.worldToLocal(place);
    return [place.x, place.y, place.z];
  }

  /// The order of splats is behind the camera.
  isSorting(): boolean {
    const { sorting, sortDirty } = this.spark as unknown as { sorting: boolean; sortDirty: boolean };
    return sorting || sortDirty;
  }

  /// A slow GPU is still at work: another drawing would only wait, and the page with it.
  isHolding(): boolean {
    const { sorting } = this.spark as unknown as { sorting: boolean };
    return !this.renderer.xr.isPresenting && this.pacing.isHolding(sorting);
  }

  render(): void {
    this.renderer.render(this.scene, this.camera);
    this.pacing.drew();
  }
}
