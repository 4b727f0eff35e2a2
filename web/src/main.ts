// Begins the page, and lets tests look inside.

import style from "./style.css";

import { App } from "./app";
import { element } from "./dom";
import type { Pose } from "./wire";

/// null where the browser has no WebGL 2; another canvas to find out would cost as long as the one that is drawn on.
function opened(place: HTMLElement): App | null {
  try {
    return new App(place);
  } catch (error) {
    if (String(error).includes("WebGL")) {
      place.replaceChildren();
      return null;
    }
    throw error;
  }
}

function begin(): void {
  const place = document.getElementById("splat-mapper-viewer") ?? document.body;
  document.head.append(element("style", {}, style));
  const app = opened(place);
  if (app === null) {
    const text = "This browser has no WebGL 2, which the viewer draws with. Try a newer one, or allow graphics acceleration in its settings.";
    place.append(element("p", { role: "alert" }, text));
    return;
  }
  const longTasks: number[] = [];
  try {
    new PerformanceObserver((list) => longTasks.push(...list.getEntries().map((entry) => entry.duration))).observe({ type: "longtask" });
  } catch {
    // Browsers that do not measure long tasks draw all the same.
  }
  window.addEventListener("error", (event) => app.errors.push(event.message));
  window.addEventListener("unhandledrejection", (event) => app.errors.push(String(event.reason)));
  const model = app.model;
  Object.assign(window, {
    splatMapper: {
      ready: true,
      revision: () => model.synced?.revision ?? 0,
      epoch: () => model.synced?.epoch ?? 0,
      mapId: () => model.facts?.map_id ?? "",
      ids: () => model.store.ids(),
      hash: () => model.store.hash(),
      nSplats: () => model.store.nSplats(),
      nKeyframes: () => model.keyframes.size,
      setPose: (pose: Pose | null, fx = 0, fy = 0, cx = 0, cy = 0, width = 0, height = 0) =>
        app.setPose(pose, { fx, fy, cx, cy, width, height }),
      settled: () => app.settled(),
      disconnect: () => app.connection.close(),
      reconnect: () => app.connection.open(),
      timings: app.timings,
      longTasks,
      errors: app.errors,
      app,
    },
  });
  app.start();
}

begin();
