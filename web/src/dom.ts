// Small helpers for elements: every control has a name that a screen reader says.

type Child = Node | string | null | undefined;
type Attributes = Record<string, string | boolean | ((event: never) => void)>;

export function element<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") {
      made.addEventListener(name, value as EventListener);
    } else if (value === true) {
      made.setAttribute(name, "");
    } else if (value !== false) {
      made.setAttribute(name, value);
    }
  }
  made.append(...children.filter((child): child is Node | string => child !== null && child !== undefined));
  return made;
}

export function button(name: string, text: string, pressed: () => void): HTMLButtonElement {
  return element("button", { type: "button", "aria-label": name, title: name, click: pressed }, text);
}

export function show(made: HTMLElement, isShown: boolean): void {
  made.classList.toggle("hidden", !isShown);
}

/// A number as people read it; a dash where it is not known.
export function readable(value: unknown, digits = 0, unit = ""): string {
  if (typeof value !== "number" || !Number.isFinite(value)) {
    return "–";
  }
  const text = value.toLocaleString("en", { maximumFractionDigits: digits, minimumFractionDigits: digits });
  return unit ? `${text} ${unit}` : text;
}
