// Renders a viewer's keyframes through their own lenses, into PNG files: node web/test/shots.mjs URL OUT_DIR N
import { mkdir, writeFile } from "node:fs/promises";
import { launch, settled, watch } from "./look.mjs";

const [url, out, n = "5"] = process.argv.slice(2);
await mkdir(out, { recursive: true });
const browser = await launch();
const page = await browser.newPage();
await page.setViewport({ width: 800, height: 600 });
const faults = watch(page);
await page.goto(url);
await page.waitForFunction(() => window.splatMapper?.revision() > 0, { timeout: 60000 });
const keyframes = await page.evaluate((count) => {
  const all = [...window.splatMapper.app.model.keyframes.values()].sort((a, b) => a.id - b.id);
  return Array.from({ length: count }, (_, k) => all[Math.floor((k * (all.length - 1)) / Math.max(count - 1, 1))]);
}, Number(n));
for (const keyframe of keyframes) {
  const { pose, fx, fy, cx, cy, width, height } = keyframe;
  await page.evaluate((...camera) => window.splatMapper.setPose(...camera), pose, fx, fy, cx, cy, width, height);
  await settled(page);
  const png = await page.evaluate(() => window.splatMapper.app.canvas.toDataURL("image/png").split(",")[1]);
  await writeFile(`${out}/${String(keyframe.id).padStart(6, "0")}.png`, Buffer.from(png, "base64"));
}
await browser.close();
console.log(JSON.stringify({ keyframes, faults }));
