// Draws a picture and what was seen in it. Masks come as COCO run-length encoding and become one small canvas each,
// so that toggles and sliders only draw again and ask nobody.

const COLOURS = { drivable: [0, 158, 115], lane: [240, 228, 66] };
const BOX_COLOURS = ["rgb(86 180 233)", "rgb(230 159 0)", "rgb(204 121 167)", "rgb(213 94 0)"];

function readRuns(text) {
  const runs = [];
  let position = 0;
  while (position < text.length) {
    let value = 0;
    let shift = 0;
    let more = true;
    while (more) {
      const digit = text.charCodeAt(position) - 48;
      value |= (digit & 0x1f) << shift;
      more = (digit & 0x20) !== 0;
      position += 1;
      shift += 5;
      if (!more && digit & 0x10) value |= -1 << shift;
    }
    if (runs.length > 2) value += runs[runs.length - 2];
    runs.push(value);
  }
  return runs;
}

/** Return { canvas, share }: the mask in its colour, and how much of the picture it covers, from 0 to 1. */
export function paintMask(mask, name) {
  const [height, width] = mask.size;
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = height;
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  const [red, green, blue] = COLOURS[name];
  const colour = ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0; // little-endian, as every browser's machine is
  let position = 0;
  let inside = false;
  let covered = 0;
  for (const run of readRuns(mask.counts)) {
    if (inside) {
      covered += run;
      for (let i = position; i < position + run; i += 1) pixels[(i % height) * width + Math.floor(i / height)] = colour;
    }
    position += run;
    inside = !inside;
  }
  context.putImageData(image, 0, 0);
  return { canvas, share: covered / (width * height) };
}

/** Prepare what a frame shows: { picture, boxes, drivable, lane } from an ImageBitmap and a perception. */
export function prepare(picture, perception) {
  return {
    picture,
    perception,
    boxes: perception.boxes,
    drivable: perception.drivable && paintMask(perception.drivable, "drivable"),
    lane: perception.lane && paintMask(perception.lane, "lane"),
  };
}

export function shownBoxes(frame, options) {
  return (frame.boxes ?? []).filter((box) => box.confidence >= options.confidence);
}

/** Draw a prepared frame at its full size. */
export function drawFrame(view, frame, options) {
  const { picture } = frame;
  if (view.width !== picture.width) view.width = picture.width;
  if (view.height !== picture.height) view.height = picture.height;
  const context = view.getContext("2d");
  context.globalAlpha = 1;
  context.clearRect(0, 0, view.width, view.height); // a picture with transparent parts does not hide what was drawn before
  context.drawImage(picture, 0, 0);
  for (const name of ["drivable", "lane"]) {
    if (frame[name] && options[name].show) {
      context.globalAlpha = options[name].opacity;
      context.drawImage(frame[name].canvas, 0, 0, view.width, view.height);
    }
  }
  if (options.detection.show) {
    context.globalAlpha = options.detection.opacity;
    drawBoxes(context, shownBoxes(frame, options), view);
  }
  context.globalAlpha = 1;
}

/** Draw boxes, the most confident first, and their labels; a label that would hide one before it says less or nothing. */
function drawBoxes(context, boxes, view) {
  const longest = Math.max(view.width, view.height);
  const shrunk = view.width / (view.clientWidth || view.width); // pixels of the picture to one of the page
  const size = Math.max(11, longest / 64, 10 * shrunk);
  const colour = (box) => BOX_COLOURS[box.class_id % BOX_COLOURS.length];
  context.lineWidth = Math.max(1.5, longest / 450, 1.25 * shrunk);
  for (const box of [...boxes].reverse()) {
    const [left, top, right, bottom] = box.xyxy;
    context.strokeStyle = colour(box);
    context.strokeRect(left, top, right - left, bottom - top);
  }
  context.font = `600 ${size}px system-ui, sans-serif`;
  context.textBaseline = "middle";
  const height = size * 1.4;
  const labels = [];
  for (const box of boxes) {
    const [left, top, , bottom] = box.xyxy;
    const above = top >= height ? top - height : top;
    const confidence = box.confidence.toFixed(2);
    for (const [text, y] of [
      [`${box.class_name} ${confidence}`, above],
      [confidence, above],
      [confidence, Math.min(bottom, view.height - height)],
    ]) {
      const width = context.measureText(text).width + size * 0.6;
      const x = Math.min(Math.max(0, left - context.lineWidth / 2), view.width - width);
      const hides = (label) =>
        x < label.x + label.width && label.x < x + width && y < label.y + height && label.y < y + height;
      if (labels.some(hides)) continue;
      labels.push({ x, y, width });
      context.fillStyle = colour(box);
      context.fillRect(x, y, width, height);
      context.fillStyle = "#000";
      context.fillText(text, x + size * 0.3, y + size * 0.72);
      break;
    }
  }
}
