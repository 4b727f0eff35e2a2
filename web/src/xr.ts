// Headsets: VR and passthrough, room scale where metres are known, grabbing with both hands to scale, teleport by ray.

import * as THREE from "three";

import { button } from "./dom";
import type { World } from "./world";

/// How far a teleport reaches, metres.
const REACH = 12;

type Mode = "immersive-vr" | "immersive-ar";

export class Headset {
  private readonly rig = new THREE.Group();
  private readonly ray: THREE.Line;
  private readonly spot: THREE.Mesh;
  private grab: { width: number; scale: number } | null = null;
  private readonly held = new Set<THREE.XRTargetRaySpace>();

  constructor(
    private readonly world: World,
    private readonly hasMetres: () => boolean,
  ) {
    world.scene.add(this.rig);
    this.ray = new THREE.Line(
      new THREE.BufferGeometry().setFromPoints([new THREE.Vector3(), new THREE.Vector3(0, 0, -REACH)]),
      new THREE.LineBasicMaterial({ color: 0xffffff, transparent: true, opacity: 0.6 }),
    );
    this.spot = new THREE.Mesh(new THREE.RingGeometry(0.15, 0.2, 32).rotateX(-Math.PI / 2), new THREE.MeshBasicMaterial({ color: 0xffffff }));
    this.spot.visible = false;
    world.scene.add(this.spot);
  }

  /// A button for each mode that the device offers.
  async offer(place: HTMLElement): Promise<void> {
    const modes: [Mode, string][] = [
      ["immersive-vr", "Enter VR"],
      ["immersive-ar", "AR passthrough"],
    ];
    for (const [mode, name] of modes) {
      if (await navigator.xr?.isSessionSupported(mode).catch(() => false)) {
        place.append(button(name, name, () => void this.enter(mode)));
      }
    }
  }

  async enter(mode: Mode): Promise<void> {
    const xr = this.world.renderer.xr;
    const session = await navigator.xr?.requestSession(mode, { optionalFeatures: ["local-floor", "bounded-floor", "hand-tracking"] });
    if (!session) {
      return;
    }
    xr.enabled = true;
    xr.setReferenceSpaceType("local-floor");
    // The viewer stands where the camera of the page is, upright.
    this.rig.position.copy(this.world.camera.position);
    this.rig.position.y -= this.hasMetres() ? 1.6 : 0.4;
    this.rig.add(this.world.camera, ...this.controllers());
    await xr.setSession(session);
    session.addEventListener("end", () => {
      xr.enabled = false;
      this.world.scene.add(this.world.camera);
      this.rig.clear();
      this.rig.scale.setScalar(1);
    });
  }

  private controllers(): THREE.Object3D[] {
    return [0, 1].map((k) => {
      const hand = this.world.renderer.xr.getController(k);
      hand.add(this.ray.clone());
      hand.addEventListener("selectend", () => this.teleport(hand));
      hand.addEventListener("squeezestart", () => this.held.add(hand));
      hand.addEventListener("squeezeend", () => {
        this.held.delete(hand);
        this.grab = null;
      });
      return hand;
    });
  }

  /// Each frame of a session.
  update(): void {
    const hands = [...this.held];
    const [a, b] = [hands[0], hands[1]];
    if (!a || !b) {
      return;
    }
    const width = a.position.distanceTo(b.position);
    this.grab ??= { width, scale: this.rig.scale.x };
    // Hands that part make the map larger, which is a smaller viewer.
    const scale = (this.grab.scale * this.grab.width) / Math.max(width, 0.05);
    this.rig.scale.setScalar(THREE.MathUtils.clamp(scale, 0.02, 50));
  }

  private teleport(hand: THREE.XRTargetRaySpace): void {
    const from = hand.getWorldPosition(new THREE.Vector3());
    const ahead = new THREE.Vector3(0, 0, -1).applyQuaternion(hand.getWorldQuaternion(new THREE.Quaternion()));
    const floor = this.rig.position.y;
    const share = ahead.y < -0.05 ? (from.y - floor) / -ahead.y : REACH;
    const way = ahead.multiplyScalar(Math.min(share, REACH * this.rig.scale.x));
    this.rig.position.x += way.x;
    this.rig.position.z += way.z;
    if (ahead.y >= -0.05) {
      this.rig.position.y += way.y;
    }
  }
}

/// Splats that a device draws at its rate, and the harmonics that it has room for.
export function budget(): { max_splats: number; sh_degree: number } {
  const agent = navigator.userAgent;
  if (/OculusBrowser|Quest|VisionOS/i.test(agent)) {
    return { max_splats: 250_000, sh_degree: 1 };
  }
  const isSmall = /Android|iPhone|iPad|Mobile/i.test(agent);
  return isSmall ? { max_splats: 500_000, sh_degree: 2 } : { max_splats: 2_500_000, sh_degree: 3 };
}
