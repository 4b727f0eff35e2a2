// Pictures of the page while a map grows, and of the finished map from where the keyframes were: frames for scripts/viewer_recording.
// Usage: node web/test/record.mjs PROGRAM RECORDING OUT_DIR
import { spawn } from "node:child_process";
import { mkdirSync, rmSync } from "node:fs";
import { createInterface } from "node:readline";
import { launch, settled } from "./look.mjs";

const [program, recording, out] = process.argv.slice(2);
const SIZE = { width: 720, height: 450 };
// Of the growing map, one each so many milliseconds and no more; then of the flight through it.
const EVERY_MS = 1500;
const MOST_GROWING = 60;
const FLIGHT = 24;

rmSync(out, { recursive: true, force: true });
mkdirSync(`${out}/frames`, { recursive: true });
const child = spawn(
  program,
  ["replay", recording, "--max-side", "480", "--steps", "1500", "--out", `${out}/run`, "--view", "127.0.0.1:0", "--set", "publish.shutdown_delay=600"],
  { stdio: ["ignore", "pipe", "pipe"] },
);
let hasEnded = false;
const url = await new Promise((found, lost) => {
  const look = (line) => {
    const at = line.match(/https?:\/\/[^\s]+/);
    if (at) {
      found(at[0]);
    }
    hasEnded ||= line.includes("report.html");
  };
  createInterface({ input: child.stdout }).on("line", look);
  createInterface({ input: child.stderr }).on("line", look);
  child.on("exit", () => lost(new Error("the program ended before it served a page")));
});

const browser = await launch();
const page = await browser.newPage();
await page.setViewport(SIZE);
await page.emulateMediaFeatures([{ name: "prefers-color-scheme", value: "dark" }]);
await page.goto(url);
await page.waitForFunction(() => window.splatMapper?.nSplats() > 0, { timeout: 120000 });

// Its figures are too small to read in the recording.
await page.evaluate(() => {
  [...document.querySelectorAll("button")].find((button) => button.textContent === "Panel")?.click();
});

let n = 0;
async function shoot() {
  await page.screenshot({ path: `${out}/frames/${String(n).padStart(4, "0")}.png` });
  n += 1;
}

while (!hasEnded && n < MOST_GROWING) {
  const began = Date.now();
  await shoot();
  await new Promise((done) => setTimeout(done, Math.max(0, EVERY_MS - (Date.now() - began))));
}
while (!hasEnded) {
  await new Promise((done) => setTimeout(done, 500));
}
await settled(page);
// Along the keyframes, halfway between two of them where there are too few.
const path = await page.evaluate((length) => {
  const all = [...window.splatMapper.app.model.keyframes.values()].sort((a, b) => a.id - b.id).map((k) => k.pose);
  const mixed = (a, b, t) => {
    const sign = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0 ? -1 : 1;
    const pose = a.map((x, i) => (1 - t) * x + t * (i < 4 ? sign : 1) * b[i]);
    const norm = Math.hypot(...pose.slice(0, 4));
    return pose.map((x, i) => (i < 4 ? x / norm : x));
  };
  return Array.from({ length }, (_, k) => {
    const at = (k * (all.length - 1)) / (length - 1);
    const low = Math.min(Math.floor(at), all.length - 2);
    return mixed(all[low], all[low + 1], at - low);
  });
}, FLIGHT);
const { width, height } = SIZE;
for (const pose of path) {
  await page.evaluate((p, w, h) => window.splatMapper.setPose(p, 0.75 * w, 0.75 * w, w / 2, h / 2, w, h), pose, width, height);
  await settled(page);
  await shoot();
}
await browser.close();
child.kill("SIGINT");
console.log(`${n} pictures in ${out}/frames`);
