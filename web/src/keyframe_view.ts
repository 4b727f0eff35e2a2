// A keyframe's photo beside the rendering from its pose, and a slider between both.

import { button, element, show } from "./dom";
import type { Keyframe } from "./wire";

export class KeyframeView {
  readonly box: HTMLElement;
  private readonly title = element("span", {});
  private readonly photo = element("img", { alt: "" });
  private readonly rendering = element("canvas", { "aria-label": "The map from the keyframe's pose" });
  private readonly slider = element("input", {
    type: "range",
    min: "0",
    max: "100",
    value: "50",
    "aria-label": "Photo or rendering",
  });

  constructor(closed: () => void) {
    const frame = element("div", { class: "frame" }, this.rendering, this.photo);
    const close = button("Close the photo", "×", () => {
      this.hide();
      closed();
    });
    this.box = element("section", { class: "box photo hidden", "aria-label": "Keyframe" }, element("div", { class: "row" }, this.title, close), frame, this.slider);
    this.slider.addEventListener("input", () => this.cut());
    this.photo.addEventListener("error", () => {
      this.title.textContent = `${this.title.textContent ?? ""} (no photo kept)`;
      show(this.photo, false);
    });
  }

  /// `draw` renders the map from the keyframe's camera into a canvas.
  open(keyframe: Keyframe, draw: (into: HTMLCanvasElement) => void): void {
    this.title.textContent = `Keyframe ${keyframe.id}`;
    this.photo.alt = `Photo of keyframe ${keyframe.id}`;
    show(this.photo, true);
    this.photo.src = `keyframes/${keyframe.id}.jpg`;
    draw(this.rendering);
    this.cut();
    show(this.box, true);
  }

  hide(): void {
    show(this.box, false);
  }

  private cut(): void {
    this.photo.style.clipPath = `inset(0 ${100 - Number(this.slider.value)}% 0 0)`;
  }
}
