// Exported files in headless Chromium, drawn by Spark beside `render` of the map that they were exported from, and by three,
// whose readers of KHR_gaussian_splatting and of PLY must agree.
// Usage: node web/test/files.mjs PROGRAM RUN_DIR FILES...: RUN_DIR has map.ply, map.splatmap and keyframes.tum, and `nerfstudio` beside it the camera.
import { execFileSync } from "node:child_process";
import { mkdirSync, readFileSync, readdirSync, writeFileSync } from "node:fs";
import { basename } from "node:path";
import { build } from "esbuild";
import { fileURLToPath } from "node:url";
import { launch, watch } from "./look.mjs";

const [program, run, ...files] = process.argv.slice(2);
/// Between two programs, mean of the views; and where one program draws the same splats from two files.
const LEAST_DB = 30;
const LEAST_EQUAL_DB = 45;
/// three cuts splats at another radius; nothing drawn would be about 10 dB.
const LEAST_OTHER_DB = 18;
const average = (all) => all.reduce((sum, db) => sum + db, 0) / all.length;
const N_VIEWS = 5;
const out = `${run}/drawn`;
mkdirSync(out, { recursive: true });

const rows = readFileSync(`${run}/keyframes.tum`, "utf8").split("\n").filter((line) => line && !line.startsWith("#"));
const chosen = Array.from({ length: N_VIEWS }, (_, k) => rows[Math.floor((k * (rows.length - 1)) / (N_VIEWS - 1))]);
writeFileSync(`${out}/poses.tum`, `${chosen.join("\n")}\n`);
const { w: width, h: height, fl_x: fx, fl_y: fy, cx, cy } = JSON.parse(readFileSync(`${run}/../nerfstudio/transforms.json`, "utf8"));
const lens = { width, height, fx, fy, cx, cy };
// Whole numbers are pixel centres there.
writeFileSync(`${out}/camera.json`, JSON.stringify({ ...lens, cx: cx - 0.5, cy: cy - 0.5 }));
execFileSync(program, ["render", `${run}/map.splatmap`, "--poses", `${out}/poses.tum`, "--intrinsics", `${out}/camera.json`, "--out", out]);
const images = readdirSync(out).filter((name) => name.endsWith(".png")).sort();
const views = chosen.map((row, k) => {
  const [, tx, ty, tz, x, y, z, w] = row.split(" ").map(Number);
  return { pose: [x, y, z, w, tx, ty, tz], lens, png: readFileSync(`${out}/${images[k]}`).toString("base64") };
});

const page_js = await build({
  entryPoints: [fileURLToPath(new URL("files_page.ts", import.meta.url))],
  bundle: true,
  format: "esm",
  target: "es2022",
  write: false,
  logLevel: "warning",
});
const browser = await launch();
const faults = [];
try {
  const page = await browser.newPage();
  const errors = watch(page);
  await page.addScriptTag({ type: "module", content: page_js.outputFiles[0].text });
  await page.waitForFunction(() => window.drawnBySpark !== undefined, { timeout: 60000 });
  const ply = readFileSync(`${run}/map.ply`).toString("base64");
  for (const file of files) {
    const bytes = readFileSync(file).toString("base64");
    const isGlb = file.endsWith(".glb");
    const found = isGlb
      ? await page.evaluate((...all) => window.comparedByThree(...all), [basename(file), bytes], ["map.ply", ply], views)
      : await page.evaluate((...all) => window.drawnBySpark(...all), basename(file), bytes, views);
    const mean = average(found.psnr);
    const holds = found.n > 0 && (isGlb ? mean >= LEAST_EQUAL_DB && average(found.rendered) >= LEAST_OTHER_DB : mean >= LEAST_DB);
    const how = isGlb ? `drawn by three, ${average(found.rendered).toFixed(1)} dB beside \`render\`, and beside the .ply drawn by it` : "drawn by Spark, beside `render`";
    console.log(`${holds ? "ok  " : "FAIL"} ${basename(file)}: ${found.n} splats, ${how}: ${mean.toFixed(1)} dB (${found.psnr.map((db) => db.toFixed(1)).join(", ")})`);
    if (!holds) {
      faults.push(file);
    }
  }
  if (errors.length > 0) {
    console.log(`FAIL ${errors.join("; ")}`);
    faults.push("errors");
  }
} finally {
  await browser.close();
}
process.exit(faults.length === 0 ? 0 : 1);
