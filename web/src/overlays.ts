// Lines and bodies over the splats: keyframes, trajectory, the camera now with its covariance, grids and paths.

import * as THREE from "three";

import { matrixOf, type World } from "./world";
import type { GridOverlay, Keyframe, PathOverlay, TrackedPose, Vec3 } from "./wire";

/// Live poses that are remembered.
const MAX_TRAIL = 20000;
/// Standard deviations that the ellipsoid reaches to: 95 % of all, in three dimensions.
const SIGMAS = 2.8;

export const COLOURS = { keyframe: 0x4c8dff, now: 0xff7a1a, trail: 0x20b26b, moved: 0xffd23f, plan: 0xe052a0 };

/// Corners of a camera's image at depth 1, and the lines between them.
function frustum(lens: { width: number; height: number; fx: number; fy: number; cx: number; cy: number }, size: number): number[] {
  const corner = (x: number, y: number): Vec3 => [
    ((x - lens.cx) / lens.fx) * size,
    ((y - lens.cy) / lens.fy) * size,
    size,
  ];
  const [a, b, c, d] = [corner(0, 0), corner(lens.width, 0), corner(lens.width, lens.height), corner(0, lens.height)];
  const o: Vec3 = [0, 0, 0];
  return [o, a, o, b, o, c, o, d, a, b, b, c, c, d, d, a].flat();
}

export class Overlays {
  readonly group = new THREE.Group();
  private readonly keyframeLines: THREE.LineSegments;
  private readonly track: THREE.Line;
  private readonly trail: THREE.Line;
  private readonly now = new THREE.Group();
  private readonly ellipsoid: THREE.Mesh;
  private readonly named = new Map<string, THREE.Object3D>();
  /// In the robot's map frame, on the ground.
  private readonly grids = new THREE.Group();
  private readonly plans = new THREE.Group();
  private hasGrids = true;
  private trailPoints: number[] = [];
  private flashUntil = 0;
  private movedIds = new Set<number>();

  constructor(world: World) {
    const line = (colour: number): THREE.LineBasicMaterial => new THREE.LineBasicMaterial({ color: colour, transparent: true, depthTest: false });
    this.keyframeLines = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.8, depthTest: false }));
    this.track = new THREE.Line(new THREE.BufferGeometry(), line(COLOURS.keyframe));
    this.trail = new THREE.Line(new THREE.BufferGeometry(), line(COLOURS.trail));
    this.ellipsoid = new THREE.Mesh(
      new THREE.SphereGeometry(1, 24, 16),
      new THREE.MeshBasicMaterial({ color: COLOURS.now, transparent: true, opacity: 0.35, depthTest: false }),
    );
    world.mapFrame.add(this.grids, this.plans);
    const body = new THREE.LineSegments(new THREE.BufferGeometry(), line(COLOURS.now));
    this.now.add(body);
    this.now.visible = false;
    for (const object of [this.keyframeLines, this.track, this.trail, this.now, this.ellipsoid]) {
      object.frustumCulled = false;
      object.renderOrder = 10;
      this.group.add(object);
    }
    this.ellipsoid.visible = false;
    world.splatFrame.add(this.group);
  }

  /// Size of a drawn camera, from how far keyframes lie from each other.
  size(keyframes: Keyframe[]): number {
    const steps: number[] = [];
    for (let k = 1; k < keyframes.length; k++) {
      const [a, b] = [keyframes[k - 1]?.pose, keyframes[k]?.pose];
      if (a && b) {
        steps.push(Math.hypot(a[4] - b[4], a[5] - b[5], a[6] - b[6]));
      }
    }
    steps.sort((a, b) => a - b);
    return Math.max(steps[steps.length >> 1] ?? 0.2, 1e-3) * 0.8;
  }

  setKeyframes(keyframes: Keyframe[], chosen: number | null): void {
    const [points, colours, way]: [number[], number[], number[]] = [[], [], []];
    const size = this.size(keyframes);
    const colourOf = (id: number): THREE.Color =>
      new THREE.Color(id === chosen ? COLOURS.now : this.movedIds.has(id) ? COLOURS.moved : COLOURS.keyframe);
    for (const keyframe of keyframes) {
      const matrix = matrixOf(keyframe.pose);
      const corners = frustum(keyframe, size);
      const colour = colourOf(keyframe.id);
      for (let k = 0; k < corners.length; k += 3) {
        const point = new THREE.Vector3(corners[k], corners[k + 1], corners[k + 2]).applyMatrix4(matrix);
        points.push(point.x, point.y, point.z);
        colours.push(colour.r, colour.g, colour.b);
      }
      way.push(keyframe.pose[4], keyframe.pose[5], keyframe.pose[6]);
    }
    this.fill(this.keyframeLines, points, colours);
    this.fill(this.track, way);
  }

  /// Keyframes that a correction has moved stand out for a while.
  flash(ids: Iterable<number>): void {
    this.movedIds = new Set(ids);
    this.flashUntil = performance.now() + 4000;
  }

  /// True once, when the keyframes are to be drawn as usual again.
  flashHasEnded(): boolean {
    if (this.movedIds.size === 0 || performance.now() < this.flashUntil) {
      return false;
    }
    this.movedIds.clear();
    return true;
  }

  setNow(tracked: TrackedPose, metresPerUnit: number, size: number, lens: Keyframe | undefined): void {
    this.now.visible = tracked.pose !== null;
    this.ellipsoid.visible = tracked.pose !== null && tracked.std_m !== undefined;
    if (!tracked.pose) {
      return;
    }
    const matrix = matrixOf(tracked.pose);
    matrix.decompose(this.now.position, this.now.quaternion, this.now.scale);
    const body = this.now.children[0] as THREE.LineSegments;
    const pinhole = lens ?? { width: 4, height: 3, fx: 3, fy: 3, cx: 2, cy: 1.5 };
    this.fill(body, frustum(pinhole, size * 1.5));
    this.ellipsoid.position.copy(this.now.position);
    const std = tracked.std_m ?? [0, 0, 0];
    this.ellipsoid.scale.fromArray(std.map((v) => Math.max((SIGMAS * v) / metresPerUnit, 1e-4)));
    const [, , , , x, y, z] = tracked.pose;
    this.trailPoints.push(x, y, z);
    if (this.trailPoints.length > 3 * MAX_TRAIL) {
      // Every second of the older half: the way stays, and what is kept has a bound.
      const half = this.trailPoints.length / 2;
      this.trailPoints = this.trailPoints.filter((_, k) => k >= half || Math.floor(k / 3) % 2 === 0);
    }
    this.fill(this.trail, this.trailPoints);
  }

  clearTrail(): void {
    this.trailPoints = [];
    this.fill(this.trail, []);
  }

  setPath(path: PathOverlay): void {
    const line = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: COLOURS.plan, depthTest: false, transparent: true }));
    line.frustumCulled = false;
    line.renderOrder = 11;
    this.fill(line, path.points.flat());
    this.replace(path.name, line, this.plans);
  }

  async setGrid(grid: GridOverlay): Promise<void> {
    const answer = await fetch(`data:image/png;base64,${grid.png}`);
    const image = await createImageBitmap(await answer.blob(), { imageOrientation: "flipY" });
    const texture = new THREE.Texture(image);
    texture.magFilter = THREE.NearestFilter;
    texture.needsUpdate = true;
    const [width, height] = [grid.width * grid.resolution, grid.height * grid.resolution];
    const plane = new THREE.Mesh(
      new THREE.PlaneGeometry(width, height).translate(width / 2, height / 2, 0),
      new THREE.MeshBasicMaterial({ map: texture, transparent: true, opacity: 0.6, side: THREE.DoubleSide }),
    );
    plane.quaternion.fromArray(grid.rotation);
    plane.position.fromArray(grid.translation);
    this.replace(grid.name, plane, this.grids);
  }

  /// `isPlain`: nothing but the map is to be seen.
  showGrids(isPlain: boolean): void {
    this.grids.visible = this.hasGrids && !isPlain;
  }

  toggleGrids(): void {
    this.hasGrids = !this.hasGrids;
    this.showGrids(false);
  }

  private replace(name: string, object: THREE.Object3D, parent: THREE.Object3D): void {
    const before = this.named.get(name);
    before?.removeFromParent();
    if (before instanceof THREE.Mesh || before instanceof THREE.Line) {
      before.geometry.dispose();
      const material = before.material as THREE.MeshBasicMaterial;
      material.map?.dispose();
      material.dispose();
    }
    object.renderOrder = 9;
    object.frustumCulled = false;
    parent.add(object);
    this.named.set(name, object);
  }

  private fill(object: THREE.Line | THREE.LineSegments, points: number[], colours?: number[]): void {
    object.geometry.dispose();
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
    if (colours) {
      geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
    }
    object.geometry = geometry;
    object.visible = points.length > 0;
  }
}
