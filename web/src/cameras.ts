// Where the viewer looks from: turning round a point, behind the robot's camera, or walking.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

import type { World } from "./world";
import type { Pose } from "./wire";

export type CameraMode = "follow" | "free" | "walk";

/// Share of the way to where the camera should be that it goes in a second, about.
const FOLLOW_RATE = 4;
const LOOK_RATE = 0.0025;

export class Cameras {
  mode: CameraMode = "follow";
  readonly orbit: OrbitControls;
  /// Of the scene: a step of the walker, and how far behind the robot the follower stands, metres or units.
  size = 1;
  private readonly keys = new Set<string>();
  /// Where the robot's camera is among the splats; how those lie may be said later.
  private target: Pose | null = null;
  private hasFollowed = false;
  private drag: { x: number; y: number } | null = null;
  private flight: { to: THREE.Matrix4; at: number } | null = null;

  constructor(
    private readonly world: World,
    private readonly changed: (mode: CameraMode) => void,
  ) {
    this.orbit = new OrbitControls(world.camera, world.canvas);
    this.orbit.enableDamping = true;
    this.orbit.addEventListener("start", () => {
      this.flight = null;
      if (this.mode === "follow") {
        this.setMode("free");
      }
    });
    world.camera.position.set(-3, 2, 0);
    window.addEventListener("keydown", (event) => {
      if (!(event.target instanceof HTMLInputElement)) {
        this.keys.add(event.code);
      }
    });
    window.addEventListener("keyup", (event) => this.keys.delete(event.code));
    window.addEventListener("blur", () => this.keys.clear());
    this.listenToLooks();
  }

  setMode(mode: CameraMode): void {
    this.mode = mode;
    this.orbit.enabled = mode !== "walk";
    this.restoreLens();
    if (mode === "free") {
      this.aimOrbit();
    }
    this.changed(mode);
  }

  /// The robot's camera is here now.
  follow(pose: Pose): void {
    this.target = pose;
  }

  /// Goes to where a camera stood, within a moment.
  flyTo(pose: Pose): void {
    if (this.mode === "follow") {
      this.setMode("free");
    }
    this.flight = { to: this.world.cameraMatrix(pose), at: performance.now() };
  }

  update(seconds: number): void {
    const camera = this.world.camera;
    if (this.flight) {
      const share = 1 - Math.exp(-6 * seconds);
      this.approach(this.flight.to, share);
      if (performance.now() - this.flight.at > 900) {
        this.approach(this.flight.to, 1);
        this.flight = null;
        this.aimOrbit();
      }
      return;
    }
    if (this.mode === "follow" && this.target) {
      const behind = new THREE.Matrix4().makeTranslation(0, 0.35 * this.size, 1.1 * this.size);
      // Whoever has just come stands there at once.
      const share = this.hasFollowed ? 1 - Math.exp(-FOLLOW_RATE * seconds) : 1;
      this.hasFollowed = true;
      this.approach(this.world.cameraMatrix(this.target).multiply(behind), share);
      return;
    }
    if (this.mode === "walk") {
      this.walk(seconds);
      return;
    }
    this.orbit.update();
    camera.updateMatrixWorld();
  }

  private approach(to: THREE.Matrix4, share: number): void {
    const [position, turn, scale] = [new THREE.Vector3(), new THREE.Quaternion(), new THREE.Vector3()];
    to.decompose(position, turn, scale);
    this.world.camera.position.lerp(position, share);
    this.world.camera.quaternion.slerp(turn, share);
  }

  /// The point that the orbit turns round lies ahead.
  private aimOrbit(): void {
    const ahead = new THREE.Vector3(0, 0, -2 * this.size).applyQuaternion(this.world.camera.quaternion);
    this.orbit.target.copy(this.world.camera.position).add(ahead);
  }

  private restoreLens(): void {
    this.world.camera.updateProjectionMatrix();
  }

  private walk(seconds: number): void {
    const held = (...codes: string[]): number => (codes.some((code) => this.keys.has(code)) ? 1 : 0);
    const step = new THREE.Vector3(
      held("KeyD", "ArrowRight") - held("KeyA", "ArrowLeft"),
      held("KeyE") - held("KeyQ"),
      held("KeyS", "ArrowDown") - held("KeyW", "ArrowUp"),
    );
    const speed = this.size * (held("ShiftLeft", "ShiftRight") ? 3 : 1);
    step.multiplyScalar(speed * seconds).applyQuaternion(this.world.camera.quaternion);
    this.world.camera.position.add(step);
  }

  private listenToLooks(): void {
    const canvas = this.world.canvas;
    canvas.addEventListener("pointerdown", (event) => {
      this.drag = this.mode === "walk" ? { x: event.clientX, y: event.clientY } : null;
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.drag) {
        return;
      }
      const euler = new THREE.Euler().setFromQuaternion(this.world.camera.quaternion, "YXZ");
      euler.y -= (event.clientX - this.drag.x) * LOOK_RATE;
      euler.x = THREE.MathUtils.clamp(euler.x - (event.clientY - this.drag.y) * LOOK_RATE, -1.5, 1.5);
      euler.z = 0;
      this.world.camera.quaternion.setFromEuler(euler);
      this.drag = { x: event.clientX, y: event.clientY };
    });
    window.addEventListener("pointerup", () => {
      this.drag = null;
    });
  }
}
