// Measures the page of a frame: width, height, what is too wide or too faint, pictures that are missing.
function channels(colour) {
  const numbers = (colour.match(/[\d.]+/g) || [0, 0, 0, 0]).map(Number);
  return [numbers[0], numbers[1], numbers[2], numbers.length > 3 ? numbers[3] : 1];
}

function over(top, below) {
  return [0, 1, 2].map(k => top[k] * top[3] + below[k] * (1 - top[3])).concat(1);
}

// WCAG 2.2, relative luminance
function luminance(colour) {
  const linear = colour.slice(0, 3).map(value => value / 255).map(value => value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
  return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
}

function contrast(one, other) {
  const [dark, bright] = [luminance(one), luminance(other)].sort((a, b) => a - b);
  return (bright + 0.05) / (dark + 0.05);
}

function measured(frame) {
  const view = frame.contentWindow, page = view.document, root = page.documentElement;
  const backgroundOf = element => {
    const layers = [];
    for (let current = element; current; current = current.parentElement) layers.push(channels(view.getComputedStyle(current).backgroundColor));
    return layers.reverse().reduce((below, top) => over(top, below), [255, 255, 255, 1]);
  };
  const scrolls = element => ["auto", "scroll", "hidden"].includes(view.getComputedStyle(element).overflowX);
  const isInsideScroll = element => {
    for (let current = element.parentElement; current; current = current.parentElement) if (scrolls(current)) return true;
    return false;
  };
  const faint = [], wide = [];
  for (const element of page.body.querySelectorAll("*")) {
    const box = element.getBoundingClientRect();
    if (!box.width || !element.checkVisibility({ opacityProperty: true, visibilityProperty: true })) continue;
    if (box.right > view.innerWidth + 1 && !isInsideScroll(element)) wide.push(`${element.tagName} ${element.className}`);
    const words = [...element.childNodes].filter(node => node.nodeType === 3).map(node => node.textContent.trim()).join(" ").trim();
    if (!words || element.closest("script, style, svg:has(image)")) continue;
    const style = view.getComputedStyle(element), isText = element.tagName === "text";
    const background = isText && element.closest(".found") ? channels(style.stroke) : backgroundOf(element);
    const ratio = contrast(over(channels(isText ? style.fill : style.color), background), background);
    const isLarge = parseFloat(style.fontSize) >= 24;
    if (ratio < (isLarge ? 3 : 4.5)) faint.push(`${ratio.toFixed(1)}: ${words.slice(0, 40)}`);
  }
  return {
    width_px: view.innerWidth,
    height_px: root.scrollHeight,
    overflow_px: root.scrollWidth - view.innerWidth,
    wide,
    faint,
    missing: [...page.images].filter(image => image.complete && !image.naturalWidth).map(image => image.alt),
  };
}

addEventListener("load", () => setTimeout(() => {
  const found = [...document.querySelectorAll("iframe")].map(measured);
  document.querySelector("pre").textContent = JSON.stringify(found);
}, 200));
