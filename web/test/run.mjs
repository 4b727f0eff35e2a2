// The page in headless Chromium against the real server: a live run, random revisions, a break, the same poses as `render`, a headset, small screens.
// Usage: node web/test/run.mjs PROGRAM EXAMPLE RECORDING OUT_DIR [PART...]
// PROGRAM: splat-mapper; EXAMPLE: examples/view_load; figures are printed, and what is wrong fails.
import { execFileSync, spawn } from "node:child_process";
import { mkdirSync, readFileSync, readdirSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { resolve } from "node:path";
import { createInterface } from "node:readline";
import { OUT, launch, settled, state, watch } from "./look.mjs";

const [program, example, recording, out] = process.argv.slice(2);
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));
const faults = [];
const children = [];

function check(holds, text) {
  console.log(`${holds ? "ok  " : "FAIL"} ${text}`);
  if (!holds) {
    faults.push(text);
  }
}

// Starts a program and resolves with the first line that has an address.
function serve(command, args) {
  const child = spawn(command, args, { stdio: ["ignore", "pipe", "pipe"] });
  children.push(child);
  child.lines = [];
  const url = new Promise((found, lost) => {
    const look = (line) => {
      child.lines.push(line);
      const at = line.match(/https?:\/\/[^\s]+/);
      if (at) {
        found(at[0]);
      }
    };
    createInterface({ input: child.stdout }).on("line", look);
    createInterface({ input: child.stderr }).on("line", look);
    child.on("exit", () => lost(new Error(child.lines.join("\n"))));
  });
  url.catch(() => {});
  return { child, url };
}

const ended = (child) => (child.exitCode === null ? new Promise((done) => child.on("exit", done)) : child.exitCode);

async function opened(browser, url, more = {}) {
  const page = await browser.newPage();
  await page.setViewport({ width: 1280, height: 800, ...more });
  if (more.before) {
    await page.evaluateOnNewDocument(more.before);
  }
  page.faults = watch(page);
  await page.goto(url);
  await page.waitForFunction(() => window.splatMapper?.nSplats() > 0, { timeout: 120000 });
  return page;
}

// Once nothing comes any more.
async function calm(page) {
  for (let before = ""; ; ) {
    const now = await state(page);
    const text = JSON.stringify([now.hash, now.revision, now.n]);
    if (text === before) {
      return now;
    }
    before = text;
    await sleep(2500);
  }
}

async function live(browser) {
  const { child, url } = serve(program, ["run", "--source", `mcap:${recording}`, "--out", `${out}/live`, "--view", "127.0.0.1:0", "--set", "publish.shutdown_delay=600"]);
  const page = await opened(browser, await url);
  // Again, now that there is a map.
  await page.reload();
  await page.waitForFunction(() => window.splatMapper?.timings.firstSplatsAt > 0, { timeout: 60000 });
  const { timings } = await state(page);
  console.log(`     page loaded after ${timings.pageLoadedAt.toFixed(0)} ms, first splats ${(timings.firstSplatsAt - timings.connectedAt).toFixed(0)} ms after it connected`);
  check(timings.pageLoadedAt < 9000, "the page loads (3 s are the aim on an idle machine)");
  await page.screenshot({ path: `${OUT}/live.png` });
  // The end of a run writes its report; the viewer stays.
  while (!child.lines.some((line) => line.includes("report.html"))) {
    await sleep(200);
  }
  const report = JSON.parse(readFileSync(`${out}/live/report.json`));
  await page.waitForFunction((n) => window.splatMapper.nSplats() === n, { timeout: 60000 }, report.splats).catch(() => {});
  const found = await calm(page);
  console.log(`     ${found.n} splats at revision ${found.revision}, ${found.keyframes} keyframes`);
  check(found.n > 1000 && found.n === report.splats, "the page holds the splats of the report");
  check(found.errors.length === 0 && page.faults.length === 0, `no error on the page: ${[...found.errors, ...page.faults].join("; ")}`);
  // Who comes when no frame comes any more stands behind the camera all the same, upright.
  const late = await opened(browser, await url);
  await late.waitForFunction(() => window.splatMapper?.nSplats() > 0, { timeout: 60000 });
  await sleep(3000);
  const off = await late.evaluate(() => {
    const { world, cameras } = window.splatMapper.app;
    const wanted = world.camera.clone();
    world.cameraMatrix(cameras.target).decompose(wanted.position, wanted.quaternion, wanted.scale);
    return { turn: world.camera.quaternion.angleTo(wanted.quaternion), up: wanted.up.clone().applyQuaternion(world.camera.quaternion).y };
  });
  check(off.turn < 0.05 && off.up > 0.8, `a late page follows the camera: ${off.turn.toFixed(3)} rad off, up ${off.up.toFixed(2)}`);
  await late.close();
  await page.evaluate(() => window.splatMapper.disconnect());
  await sleep(1000);
  await page.evaluate(() => window.splatMapper.reconnect());
  const again = await calm(page);
  check(String(again.hash) === String(found.hash) && again.n === found.n, "after a break the page holds the same");
  await page.close();
  child.kill("SIGINT");
  await ended(child);
}

async function random(browser) {
  const { child, url } = serve(example, ["--splats", "20000", "--revisions", "1000", "--millis", "10", "--loop-at", "500"]);
  const page = await opened(browser, await url);
  const until = (text) => child.lines.find((line) => line.startsWith(text));
  // Away from the midst of it until after the last revision.
  await page.waitForFunction(() => window.splatMapper.revision() > 100, { timeout: 60000 });
  await page.evaluate(() => window.splatMapper.disconnect());
  const left = await page.evaluate(() => window.splatMapper.revision());
  await sleep(30000);
  while (!until("{")) {
    await sleep(100);
  }
  const wanted = JSON.parse(until("{"));
  check(left < wanted.revision, "the map changes while the page is away");
  const began = Date.now();
  await page.evaluate(() => window.splatMapper.reconnect());
  await page.waitForFunction((r) => window.splatMapper.revision() === r, { timeout: 60000 }, wanted.revision);
  const millis = Date.now() - began;
  console.log(`     from revision ${left} to ${wanted.revision} ${millis} ms after a break of 30 s`);
  check(millis < 9000, "the page catches up soon after a break (3 s are the aim on an idle machine)");
  const found = await page.evaluate(() => {
    const ids = window.splatMapper.ids();
    let sum = 0;
    ids.forEach((id) => (sum = (sum + id) >>> 0));
    return { n: ids.length, sum, epoch: window.splatMapper.epoch(), errors: window.splatMapper.errors };
  });
  check(found.n === wanted.n && found.sum === wanted.sum_of_ids && found.epoch === wanted.epoch, `1,000 random revisions, a loop and a break: ${found.n} splats, ids as the server's`);
  check(found.errors.length === 0 && page.faults.length === 0, `no error: ${[...found.errors, ...page.faults].join("; ")}`);
  // Nonsense is said, and what is right comes again.
  await page.evaluate(() => {
    window.splatMapper.app.take(new Uint8Array([1, 0, 0, 0, 255, 255, 255, 255]).buffer);
    window.splatMapper.app.take("{");
    window.splatMapper.app.take('{"type":"synced","epoch":1,"revision":1,"n_splats":1,"hash":[0,0]}');
  });
  await page.waitForFunction((n) => window.splatMapper.nSplats() === n && window.splatMapper.errors.length >= 3, { timeout: 60000 }, wanted.n);
  check(true, "malformed messages lead to a fresh copy");
  await page.close();
  child.kill();
}

async function poses(browser) {
  const { child, url } = serve(program, ["view", `${out}/live`, "--at", "127.0.0.1:0"]);
  const page = await opened(browser, await url, { width: 800, height: 600 });
  await page.waitForFunction(() => window.splatMapper.revision() > 0);
  const keyframes = await page.evaluate(() => {
    const all = [...window.splatMapper.app.model.keyframes.values()].sort((a, b) => a.id - b.id);
    return [0, 1, 2, 3, 4].map((k) => all[Math.floor((k * (all.length - 1)) / 4)]);
  });
  const { width, height, fx, fy, cx, cy } = keyframes[0];
  // Whole numbers are pixel centres there.
  writeFileSync(`${out}/camera.json`, JSON.stringify({ width, height, fx, fy, cx: cx - 0.5, cy: cy - 0.5 }));
  const rows = keyframes.map(({ pose: [x, y, z, w, tx, ty, tz] }, k) => [k, tx, ty, tz, x, y, z, w].join(" "));
  writeFileSync(`${out}/poses.tum`, `${rows.join("\n")}\n`);
  execFileSync(program, ["render", `${out}/live/map.splatmap`, "--poses", `${out}/poses.tum`, "--intrinsics", `${out}/camera.json`, "--out", `${out}/rendered`]);
  const files = readdirSync(`${out}/rendered`).filter((name) => name.endsWith(".png")).sort();
  for (const [k, keyframe] of keyframes.entries()) {
    await page.evaluate((...camera) => window.splatMapper.setPose(...camera), keyframe.pose, fx, fy, cx, cy, width, height);
    await settled(page);
    const png = readFileSync(`${out}/rendered/${files[k]}`).toString("base64");
    const psnr = await page.evaluate(comparison, png);
    check(psnr >= 30, `keyframe ${keyframe.id} is drawn as \`render\` draws it: ${psnr.toFixed(1)} dB`);
  }
  await page.evaluate(() => window.splatMapper.setPose(null));
  await page.evaluate(() => window.splatMapper.app.canvas.focus());
  await settled(page);
  await page.screenshot({ path: `${OUT}/map_light.png` });
  await page.emulateMediaFeatures([{ name: "prefers-color-scheme", value: "dark" }]);
  await page.reload();
  await page.waitForFunction(() => window.splatMapper?.revision() > 0);
  await settled(page);
  await page.screenshot({ path: `${OUT}/map_dark.png` });
  await page.setViewport({ width: 390, height: 844, isMobile: true, hasTouch: true });
  await settled(page);
  await page.screenshot({ path: `${OUT}/phone.png` });
  const unnamed = await page.evaluate(() => [...document.querySelectorAll("button, input, select, canvas")].filter((control) => !control.getAttribute("aria-label")).length);
  check(unnamed === 0, "every control has a name");
  const isWide = await page.evaluate(() => document.documentElement.scrollWidth > window.innerWidth);
  check(!isWide, "nothing is wider than a phone");
  check(page.faults.length === 0, `no error on the page: ${page.faults.join("; ")}`);
  await page.close();
  await headset(browser, await url);
  child.kill("SIGINT");
  await ended(child);
}

// In the page: dB between the canvas and a PNG.
async function comparison(png) {
  const image = await createImageBitmap(await (await fetch(`data:image/png;base64,${png}`)).blob());
  const pixels = (source) => {
    const canvas = new OffscreenCanvas(image.width, image.height);
    const context = canvas.getContext("2d");
    context.drawImage(source, 0, 0);
    return context.getImageData(0, 0, image.width, image.height).data;
  };
  const [a, b] = [pixels(window.splatMapper.app.canvas), pixels(image)];
  let sum = 0;
  for (let k = 0; k < a.length; k++) {
    sum += k % 4 === 3 ? 0 : (a[k] - b[k]) ** 2;
  }
  return 10 * Math.log10((255 ** 2 * a.length * 0.75) / sum);
}

async function report(browser) {
  const page = await browser.newPage();
  await page.setViewport({ width: 1280, height: 1000 });
  page.faults = watch(page);
  await page.goto(`file://${resolve(out)}/live/report.html`);
  await page.click("#walk");
  await page.waitForFunction(() => window.splatMapper?.revision() > 0, { timeout: 60000 });
  await settled(page);
  await page.evaluate(() => document.getElementById("splat-mapper-viewer").scrollIntoView());
  await page.screenshot({ path: `${OUT}/report.png` });
  const found = await state(page);
  const { splats } = JSON.parse(readFileSync(`${out}/live/report.json`));
  check(found.n === splats, "the report holds the map");
  check(found.errors.length === 0 && page.faults.length === 0, `no error in the report: ${[...found.errors, ...page.faults].join("; ")}`);
  await page.close();
}

async function headset(browser, url) {
  const emulator = readFileSync(createRequire(import.meta.url).resolve("iwer/build/iwer.min.js"), "utf8");
  const install = `${emulator}; window.device = new IWER.XRDevice(IWER.metaQuest3); window.device.installRuntime({ forceInstall: true });`;
  const page = await opened(browser, url, { before: install });
  const button = await page.waitForSelector('button[aria-label="Enter VR"]', { timeout: 20000 });
  await button.click();
  await page.waitForFunction(() => window.splatMapper.app.world.renderer.xr.isPresenting, { timeout: 20000 });
  await sleep(3000);
  const views = await page.evaluate(() => window.splatMapper.app.world.renderer.xr.getCamera().cameras.length);
  check(views === 2, `a headset's session draws ${views} views`);
  await page.screenshot({ path: `${OUT}/vr.png` });
  const { errors } = await state(page);
  check(errors.length === 0, `no error in the session: ${errors.join("; ")}`);
  await page.close();
}

async function million(browser) {
  const { child, url } = serve(example, ["--splats", "1000000", "--revisions", "1"]);
  // Small, since a million splats are drawn without a GPU here.
  const page = await opened(browser, await url, { width: 320, height: 240 });
  await page.waitForFunction(() => window.splatMapper.revision() === 1, { timeout: 240000 });
  const found = await page.evaluate(() => {
    const store = window.splatMapper.app.model.store;
    let bytes = 0;
    store.chunks.forEach((chunk) => {
      bytes += chunk.capacity * 4 * (5 + chunk.harmonics.length * 2);
    });
    return { bytes, heap: performance.memory?.usedJSHeapSize ?? 0, n: store.nSplats(), longest: Math.max(0, ...window.splatMapper.longTasks), tasks: window.splatMapper.longTasks.length };
  });
  console.log(`     1 M splats: ${((found.bytes + found.heap) / found.n).toFixed(0)} bytes a splat (arrays ${(found.bytes / found.n).toFixed(0)}), longest task ${found.longest.toFixed(0)} ms of ${found.tasks} above 50 ms`);
  check(found.n === 1000000, "a million splats arrive");
  check((found.bytes + found.heap) / found.n <= 200, "at most 200 bytes a splat");
  await page.close();
  child.kill();
}

mkdirSync(out, { recursive: true });
const browser = await launch();
try {
  const parts = { live, report, random, poses, million };
  const names = process.argv.slice(6);
  for (const [name, part] of Object.entries(parts)) {
    if (names.length === 0 || names.includes(name)) {
      await part(browser);
    }
  }
} catch (error) {
  check(false, String(error.stack ?? error));
} finally {
  await browser.close();
  children.forEach((child) => child.kill("SIGKILL"));
}
console.log(faults.length === 0 ? "the viewer is fine" : `${faults.length} faults`);
process.exit(faults.length === 0 ? 0 : 1);
