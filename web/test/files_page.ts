// A page that draws exported files with readers that are not ours: Spark's for .ply, .spz, .splat and .compressed.ply, three's for .glb beside .ply.

import { SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { GLTFLoader } from "three-0187/examples/jsm/loaders/GLTFLoader.js";
import { GLTFGaussianSplatLoaderExtension } from "three-0187/examples/jsm/loaders/GLTFGaussianSplatLoaderExtension.js";
import { GaussianSplatPLYLoader } from "three-0187/examples/jsm/loaders/GaussianSplatPLYLoader.js";
import { GaussianSplat } from "three-0187/examples/jsm/objects/GaussianSplat.js";
import * as WEBGPU from "three-0187/webgpu";

import type { Pose } from "../src/wire";
import { type Pinhole, World, matrixOf } from "../src/world";

interface View {
  pose: Pose;
  lens: Pinhole;
  png: string;
}

async function bytesOf(base64: string): Promise<ArrayBuffer> {
  return (await fetch(`data:application/octet-stream;base64,${base64}`)).arrayBuffer();
}

/// Peak signal-to-noise ratio between an image and a PNG, in dB.
async function psnr(canvas: CanvasImageSource, png: string): Promise<number> {
  const image = await createImageBitmap(new Blob([await bytesOf(png)]));
  const pixels = (source: CanvasImageSource) => {
    const context = new OffscreenCanvas(image.width, image.height).getContext("2d")!;
    context.fillRect(0, 0, image.width, image.height);
    context.drawImage(source, 0, 0);
    return context.getImageData(0, 0, image.width, image.height).data;
  };
  const [a, b] = [pixels(canvas), pixels(image)];
  let sum = 0;
  for (let k = 0; k < a.length; k++) {
    sum += k % 4 === 3 ? 0 : (a[k]! - b[k]!) ** 2;
  }
  // Equal images: finite, for JSON has no other.
  return 10 * Math.log10((255 ** 2 * a.length * 0.75) / Math.max(sum, 1));
}

/// Each view drawn by Spark -> dB beside the PNG of it. SPZ has x right, y up, z back; the others have y down, z ahead.
async function drawnBySpark(name: string, base64: string, views: View[]): Promise<{ n: number; psnr: number[] }> {
  const canvas = document.createElement("canvas");
  const world = new World(canvas);
  world.renderer.setPixelRatio(1);
  world.place({ rotation: [0, 0, 0, 1], translation: [0, 0, 0], scale: 1 } as never);
  const mesh = new SplatMesh({ fileBytes: await bytesOf(base64), fileName: name, raycastable: false });
  await mesh.initialized;
  if (name.endsWith(".spz")) {
    mesh.quaternion.set(1, 0, 0, 0);
  }
  world.splatFrame.add(mesh);
  world.scene.background = new THREE.Color(0);
  const found = [];
  for (const { pose, lens, png } of views) {
    world.renderer.setSize(lens.width, lens.height, false);
    world.lookThrough(pose, lens);
    // A worker sorts for the camera of the last drawing.
    for (let k = 0; k < 5; k++) {
      world.renderer.render(world.scene, world.camera);
      for (let wait = 0; wait < 100 && world.isSorting(); wait++) {
        await new Promise((done) => setTimeout(done, 20));
      }
    }
    world.renderer.render(world.scene, world.camera);
    found.push(await psnr(canvas, png));
  }
  world.renderer.dispose();
  return { n: mesh.packedSplats?.numSplats ?? 0, psnr: found };
}

/// A splat file as three's own readers take it: glTF with KHR_gaussian_splatting, or PLY.
async function loadedByThree(name: string, base64: string): Promise<WEBGPU.Object3D> {
  if (!name.endsWith(".glb")) {
    return new GaussianSplat(new GaussianSplatPLYLoader().parse(await bytesOf(base64)));
  }
  const loader = new GLTFLoader();
  loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const { scene } = await loader.parseAsync(await bytesOf(base64), "");
  // x left, y up, z ahead -> x right, y down, z ahead.
  scene.rotation.z = Math.PI;
  return scene;
}

/// Each view of a file drawn by three -> images as data URLs.
async function drawnByThree(name: string, base64: string, views: View[]): Promise<{ n: number; drawn: string[] }> {
  const loaded = await loadedByThree(name, base64);
  const canvas = document.createElement("canvas");
  const renderer = new WEBGPU.WebGPURenderer({ canvas, antialias: false });
  renderer.outputColorSpace = WEBGPU.LinearSRGBColorSpace;
  await renderer.init();
  renderer.setPixelRatio(1);
  const scene = new WEBGPU.Scene();
  scene.background = new WEBGPU.Color(0);
  scene.add(loaded);
  let n = 0;
  loaded.traverse((object) => {
    n += (object as Partial<GaussianSplat>).splatGeometry?.getAttribute("position").count ?? 0;
  });
  const drawn = [];
  for (const { pose, lens } of views) {
    const camera = new WEBGPU.PerspectiveCamera(60, 1, 0.01, 2000);
    // The camera of the field looks along +z with y down, that of three along -z with y up.
    const matrix = new WEBGPU.Matrix4().fromArray(matrixOf(pose).elements).multiply(new WEBGPU.Matrix4().makeRotationX(Math.PI));
    matrix.decompose(camera.position, camera.quaternion, camera.scale);
    const { near, far } = camera;
    const [left, right] = [(-lens.cx / lens.fx) * near, ((lens.width - lens.cx) / lens.fx) * near];
    const [top, bottom] = [(lens.cy / lens.fy) * near, (-(lens.height - lens.cy) / lens.fy) * near];
    renderer.setSize(lens.width, lens.height, false);
    camera.projectionMatrix.makePerspective(left, right, top, bottom, near, far, camera.coordinateSystem);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    camera.updateMatrixWorld(true);
    // Sorted behind the camera of the last drawing.
    for (let k = 0; k < 5; k++) {
      await renderer.renderAsync(scene, camera);
      await new Promise((done) => setTimeout(done, 100));
    }
    await renderer.renderAsync(scene, camera);
    drawn.push(canvas.toDataURL());
  }
  renderer.dispose();
  return { n, drawn };
}

/// A file drawn by three beside another, and beside `render`: three projects and cuts splats otherwise.
async function comparedByThree(file: [string, string], other: [string, string], views: View[]): Promise<{ n: number; psnr: number[]; rendered: number[] }> {
  const [a, b] = [await drawnByThree(...file, views), await drawnByThree(...other, views)];
  const [found, rendered] = [[] as number[], [] as number[]];
  for (const [k, { png }] of views.entries()) {
    const drawn = await createImageBitmap(await (await fetch(a.drawn[k]!)).blob());
    found.push(await psnr(drawn, b.drawn[k]!.split(",")[1]!));
    rendered.push(await psnr(drawn, png));
  }
  return { n: a.n, psnr: found, rendered };
}

Object.assign(window, { drawnBySpark, comparedByThree });
