// Opens a viewer's page in headless Chromium and says what it holds, as JSON; screenshots go to web/test/out. Usage: node web/test/look.mjs URL [NAME]
import { mkdir } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import puppeteer from "puppeteer-core";

export const FLAGS = [
  "--use-gl=angle",
  "--use-angle=swiftshader",
  "--enable-unsafe-swiftshader",
  "--no-sandbox",
  "--disable-dev-shm-usage",
  "--ignore-certificate-errors",
];
export const OUT = fileURLToPath(new URL("out", import.meta.url));

export async function launch() {
  await mkdir(OUT, { recursive: true });
  const executablePath = process.env.CHROMIUM ?? "/usr/bin/chromium";
  return puppeteer.launch({ executablePath, args: FLAGS, headless: true, protocolTimeout: 300000 });
}

// Console errors and failed requests, gathered while a page lives.
export function watch(page) {
  const faults = [];
  page.on("console", (message) => {
    if (message.type() === "error") {
      faults.push(message.text());
    }
  });
  page.on("pageerror", (error) => faults.push(String(error)));
  page.on("requestfailed", (request) => faults.push(`${request.url()}: ${request.failure()?.errorText}`));
  return faults;
}

// Sorting happens in a worker, some frames behind.
export const settled = (page) => page.evaluate(() => window.splatMapper.settled());

export const state = (page) =>
  page.evaluate(() => {
    const s = window.splatMapper;
    return {
      revision: s.revision(),
      epoch: s.epoch(),
      mapId: s.mapId(),
      n: s.nSplats(),
      keyframes: s.nKeyframes(),
      hash: s.hash(),
      timings: s.timings,
      longest: Math.max(0, ...s.longTasks),
      errors: s.errors,
    };
  });

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  const [url, name = "view"] = process.argv.slice(2);
  const browser = await launch();
  const page = await browser.newPage();
  await page.setViewport({ width: 1280, height: 800 });
  const faults = watch(page);
  await page.goto(url);
  await page.waitForFunction(() => window.splatMapper?.revision() > 0, { timeout: 60000 });
  await new Promise((done) => setTimeout(done, 4000));
  await page.screenshot({ path: `${OUT}/${name}.png` });
  console.log(JSON.stringify({ ...(await state(page)), faults }, null, 1));
  await browser.close();
}
