// The page: wires the controls to what is seen. No library, no build step, no request but to this service.

import { ServiceError, capital, getModel, isTooMuch, pause, plural, predict, predictBatch, setToken } from "./client.js";
import { drawFrame, prepare, shownBoxes } from "./draw.js";
import { openCamera, openClip, openPhoto } from "./sources.js";

const LAYERS = ["detection", "drivable", "lane"];
const CLIP_TYPES = ["video/webm", "video/mp4"]; // what a clip is saved as, by what the browser records
const LEAST_PHOTO = 2 ** 16; // bytes of a photo that is not made smaller again
const FORM = 256; // bytes of a form around each picture
const STAGES = ["decode", "preprocess", "queue", "network", "postprocess"];

const element = (id) => document.getElementById(id);
const view = element("view");
const options = Object.fromEntries(LAYERS.map((name) => [name, { show: true, opacity: 1 }]));
options.confidence = 0.25;

let floor = 0.05; // boxes below are not even asked for
let chunkSize = 8; // frames of a clip in one request
let limits = null; // what the service takes, of /v1/models
let frames = []; // { blob, result, picture?, time? }: pictures of a clip are decoded again when they are shown
let current = null; // the prepared frame on the canvas
let position = 0;
let rate = 5;
let fileName = "picture";
let player = null; // what plays or saves the clip, until it is paused
let work = null; // AbortController of what runs now
let met = null; // promise of what the service says of its model
let retry = null; // what to do again once there is a token
let tokenSent = false; // whether a token was given that has opened nothing yet

// ---------------------------------------------------------------------------------------------- showing

function readControls() {
  for (const name of LAYERS) {
    const slider = element(`opacity-${name}`);
    options[name] = { show: element(`show-${name}`).checked, opacity: slider.value / 100 };
    slider.nextElementSibling.textContent = `${slider.value} %`;
  }
  options.confidence = Number(element("confidence").value);
  element("confidence-text").textContent = options.confidence.toFixed(2);
}

function redraw(announce = true) {
  readControls();
  if (!current) return;
  drawFrame(view, current, options);
  const boxes = shownBoxes(current, options);
  const text = describe(boxes);
  view.setAttribute("aria-label", text);
  element("summary").setAttribute("aria-live", announce ? "polite" : "off");
  if (element("summary").textContent !== text) element("summary").textContent = text;
  fillTable(
    element("objects"),
    boxes.map((box) => [box.class_name, box.confidence.toFixed(2), box.xyxy.map(Math.round).join(", ")]),
  );
  element("objects-count").textContent = ` (${boxes.length})`;
}

function describe(boxes) {
  const parts = [];
  if (current.boxes) {
    const counts = new Map();
    for (const box of boxes) counts.set(box.class_name, (counts.get(box.class_name) ?? 0) + 1);
    const names = [...counts].map(([name, count]) => `${count} ${count === 1 ? name : plural(name)}`);
    const { class_names: classes } = current.perception;
    parts.push(names.join(", ") || `no ${classes.length === 1 ? classes[0] : "objects"}`);
  }
  const percent = (share) => `${(100 * share).toFixed(share < 0.1 ? 1 : 0)} %`;
  if (current.drivable) parts.push(`drivable area ${percent(current.drivable.share)} of the picture`);
  if (current.lane) parts.push(`lane markings ${percent(current.lane.share)}`);
  return `${parts.join("; ")}.`;
}

function fillTable(body, rows) {
  body.replaceChildren(
    ...rows.map((cells) => {
      const row = document.createElement("tr");
      for (const cell of cells) row.insertCell().textContent = cell;
      return row;
    }),
  );
}

async function showFrame(index, announce = true) {
  position = index;
  const frame = frames[index];
  const picture = frame.picture ?? (await createImageBitmap(frame.blob));
  if (position !== index) return; // another was asked for meanwhile
  current = prepare(picture, frame.result.perception);
  view.hidden = false;
  element("empty").hidden = true;
  element("save-overlay").disabled = element("save-json").disabled = false;
  element("seek").value = index;
  element("seek-text").textContent = `${index + 1} / ${frames.length}`;
  showTiming(frame.result);
  redraw(announce);
}

/** Show where the time went; what several pictures took at once is no picture's own. */
function showTiming({ milliseconds, batch, roundTrip, together }) {
  const share = roundTrip / together;
  const name = (stage) => (stage === "network" && batch > 1 ? `network, for ${batch} pictures at once` : stage);
  const rows = STAGES.filter((stage) => stage in milliseconds).map((stage) => [name(stage), milliseconds[stage]]);
  rows.push([together > 1 ? `round trip of ${together} frames` : "round trip", roundTrip]);
  if (together > 1) rows.push(["a frame's share", share]);
  element("timing-total").textContent = `: ${share.toFixed(0)} ms`;
  fillTable(element("timing"), rows.map(([label, value]) => [label, value.toFixed(1)]));
}

/** The form in which this browser records the canvas, or undefined. */
function clipType() {
  if (!window.MediaRecorder || !view.captureStream) return undefined;
  return CLIP_TYPES.find((type) => MediaRecorder.isTypeSupported(type));
}

function showPlayer() {
  const several = frames.length > 1;
  element("player").hidden = !several;
  element("save-clip").hidden = !several || !clipType();
  element("seek").max = Math.max(0, frames.length - 1);
}

function showError(message) {
  element("error").textContent = message;
  element("error").hidden = !message;
}

// ---------------------------------------------------------------------------------------------- working

/** Say again what is shown, after a job that brought nothing new. */
function tellCurrent() {
  if (current) redraw();
  else element("summary").textContent = "";
}

/** Learn which model is served: before the first job, or with the first one that has the token. */
async function meet() {
  try {
    const model = await getModel();
    showTasks(model.card);
    element("model").textContent = `model ${model.name} on ${model.backend}`;
    floor = Math.max(Math.min(floor, model.confidence), model.least_confidence);
    chunkSize = Math.min(chunkSize, model.max_images);
    const { max_pixels, max_side, max_body } = model;
    limits = { max_pixels, max_side, max_body: max_body - FORM };
    setSlider(element("confidence"), model.confidence);
    readControls();
  } catch (error) {
    met = null;
    throw error;
  }
}

/** Name what the model sees, and leave out what it does not. */
function showTasks({ class_names: classes, tasks }) {
  const objects = classes.join() === "vehicle" ? "vehicles" : "objects";
  const names = { detection: objects, drivable: "drivable area", lane: "lane markings" };
  element("name-detection").textContent = capital(objects);
  element("opacity-detection").setAttribute("aria-label", `Opacity of ${objects}`);
  for (const name of LAYERS) element(`show-${name}`).disabled = element(`opacity-${name}`).disabled = !tasks.includes(name);
  element("confidence").closest(".field").hidden = element("objects-details").hidden = !tasks.includes("detection");
  const seen = LAYERS.filter((name) => tasks.includes(name)).map((name) => names[name]);
  element("tasks").textContent = capital(new Intl.ListFormat("en-GB").format(seen));
}

/** Put a slider exactly on a value, which need not be round: its steps are counted from its least value. */
function setSlider(slider, value) {
  const steps = Math.floor((value - floor) / slider.step + 1e-6);
  slider.min = (value - steps * slider.step).toFixed(6);
  slider.max = Math.max(slider.max, value);
  slider.value = value;
}

/** Run a job; another one stops it. Errors are shown, and a missing token is asked for. */
async function run(job) {
  work?.abort();
  stopPlaying();
  const mine = new AbortController();
  work = mine;
  showError("");
  element("stop").hidden = false;
  element("progress-row").hidden = true; // of the job before
  document.body.removeAttribute("aria-busy");
  element("save-clip").disabled = true; // until all of a clip has been seen
  try {
    await (met ??= meet());
    mine.signal.throwIfAborted();
    await job(mine.signal);
    tokenSent = false;
  } catch (error) {
    if (work === mine) tellCurrent();
    if (mine.signal.aborted) return; // whatever it ended with: something newer is shown
    if (error instanceof ServiceError && error.status === 401) {
      if (tokenSent) showError("The service does not take this token.");
      tokenSent = false;
      retry = job;
      element("token-form").hidden = false;
      element("token").focus();
    } else {
      showError(error.message);
    }
  } finally {
    if (work === mine) {
      work = null;
      element("stop").hidden = true;
      element("progress-row").hidden = true;
      document.body.removeAttribute("aria-busy");
      element("save-clip").disabled = false;
    }
  }
}

function openFile(file) {
  if (!file) return;
  const name = file.name?.replace(/\.[^.]*$/, "") || "picture";
  run((signal) => (file.type.startsWith("video/") ? seeClip(file, name, signal) : seePhoto(file, name, signal)));
}

async function seePhoto(file, name, signal) {
  element("summary").textContent = "Looking …";
  document.body.setAttribute("aria-busy", "true");
  const { blob, picture, result } = await predictPhoto(file, signal);
  frames = [{ blob, result, picture: picture ?? (await createImageBitmap(blob)) }];
  fileName = name;
  showPlayer();
  await showFrame(0);
}

/** See a photo; one that is refused as too much is sent smaller. */
async function predictPhoto(file, signal) {
  for (let most = limits.max_body; ; ) {
    const { blob, picture } = await openPhoto(file, { ...limits, max_body: most });
    try {
      return { blob, picture, result: await predict(blob, floor, signal) };
    } catch (error) {
      picture?.close();
      if (!isTooMuch(error) || !picture || blob.size <= LEAST_PHOTO) throw error;
      most = blob.size / 2;
      element("summary").textContent = "Too much at once: sending a smaller picture …";
    }
  }
}

async function seeClip(file, name, signal) {
  const wanted = Number(element("rate").value);
  const seen = [];
  const bar = element("progress");
  element("progress-row").hidden = false;
  bar.value = 0;
  element("progress-text").textContent = "Opening the clip …";
  let most = chunkSize;
  let waiting = [];
  for await (const frame of openClip(file, wanted, limits, signal)) {
    if (frame.index === 0 && frame.seconds * wanted >= frame.count + 1) {
      const reach = (frame.count / wanted).toFixed(0);
      showError(
        `Only the first ${reach} s of ${frame.seconds.toFixed(0)} s are looked at: ${frame.count} frames are the most. ` +
          "Choose fewer frames per second or a shorter clip.",
      );
    }
    frame.picture.close();
    waiting.push(frame);
    const last = frame.index === frame.count - 1;
    while (waiting.length >= (last ? 1 : most)) {
      const chunk = waiting.slice(0, countFitting(waiting, most));
      let results;
      try {
        results = await predictBatch(chunk.map((one) => one.blob), floor, signal);
      } catch (error) {
        if (!isTooMuch(error) || chunk.length === 1) throw error;
        most = Math.ceil(chunk.length / 2);
        element("progress-text").textContent = `Too much at once: sending ${most} frames instead of ${chunk.length} …`;
        continue;
      }
      waiting = waiting.slice(chunk.length);
      seen.push(...chunk.map(({ blob, time }, index) => ({ blob, time, result: results[index] })));
      frames = seen; // only now: until its first frames are seen, what was shown before stays whole
      fileName = name;
      rate = wanted;
      bar.value = frames.length / frame.count;
      element("progress-text").textContent = `Frame ${frames.length} of ${frame.count}`;
      showPlayer();
      if (!player) await showFrame(frames.length - 1, false);
    }
  }
  if (!player) await showFrame(0);
}

/** How many of the first frames go into one request, at least one and at most `most`. */
function countFitting(waiting, most) {
  let count = 0;
  for (let room = limits.max_body + FORM; count < Math.min(most, waiting.length); count += 1) {
    room -= waiting[count].blob.size + FORM;
    if (room < 0) break;
  }
  return Math.max(1, count);
}

async function seeCamera(signal) {
  for await (const { blob, picture } of openCamera(limits, signal)) {
    const result = await predict(blob, floor, signal);
    frames[0]?.picture?.close?.();
    frames = [{ blob, result, picture }];
    fileName = "camera";
    showPlayer();
    await showFrame(0, false);
  }
}

// ---------------------------------------------------------------------------------------------- playing and saving

function stopPlaying() {
  player = null;
  element("play").textContent = "Play";
}

async function play() {
  if (player) return stopPlaying();
  const mine = (player = {});
  element("play").textContent = "Pause";
  if (position === frames.length - 1) await showFrame(0, false);
  while (player === mine && position < frames.length - 1) {
    await pause(1000 / rate);
    if (player === mine) await showFrame(position + 1, false);
  }
  if (player === mine) stopPlaying();
}

function save(blob, suffix) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = `${fileName}${suffix}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

function saveJson() {
  const shown = frames.map(({ result, time }, index) => {
    const { perception } = result;
    const boxes = perception.boxes?.filter((box) => box.confidence >= options.confidence) ?? null;
    const place = frames.length > 1 ? { frame: index, timestamp: time } : {};
    return { ...perception, ...place, source: fileName, boxes };
  });
  const whole = shown.length === 1 ? shown[0] : { schema: shown[0].schema, source: fileName, frames: shown };
  const text = JSON.stringify(whole, null, 1);
  save(new Blob([text], { type: "application/json" }), ".json");
}

async function saveClip() {
  const mine = (player = {}); // another job, whose frames are others, ends it as it ends the playing
  element("play").textContent = "Play";
  const button = element("save-clip");
  const recorder = new MediaRecorder(view.captureStream(), { mimeType: clipType() });
  const controls = [button, element("play"), element("seek")]; // which would change what is recorded
  for (const control of controls) control.disabled = true;
  const pieces = [];
  recorder.ondataavailable = (event) => pieces.push(event.data);
  const stopped = new Promise((resolve) => {
    recorder.onstop = resolve;
  });
  await showFrame(0, false);
  recorder.start();
  for (let index = 0; player === mine && index < frames.length; index += 1) {
    button.textContent = `Saving ${index + 1} / ${frames.length}`;
    await showFrame(index, false);
    await pause(1000 / rate);
  }
  recorder.stop();
  await stopped;
  const [type] = recorder.mimeType.split(";"); // without the codecs
  if (player === mine) save(new Blob(pieces, { type }), `.${type.split("/")[1]}`);
  else showError("The clip was not saved, as something else was opened.");
  player = null;
  button.textContent = "Save clip";
  for (const control of controls) control.disabled = control === button && work !== null;
}

// ---------------------------------------------------------------------------------------------- wiring

for (const name of LAYERS) {
  element(`show-${name}`).addEventListener("change", () => redraw(false));
  element(`opacity-${name}`).addEventListener("input", () => redraw(false));
}
element("confidence").addEventListener("input", () => redraw());
element("file").addEventListener("change", (event) => {
  openFile(event.target.files[0]);
  event.target.value = ""; // the same file may be chosen again
});
element("camera").addEventListener("click", () => run(seeCamera));
element("stop").addEventListener("click", () => {
  work?.abort();
  element("camera").focus();
});
element("play").addEventListener("click", play);
element("seek").addEventListener("input", (event) => {
  stopPlaying();
  showFrame(Number(event.target.value));
});
element("save-overlay").addEventListener("click", () => view.toBlob((blob) => save(blob, "-overlay.png"), "image/png"));
element("save-json").addEventListener("click", saveJson);
element("save-clip").addEventListener("click", saveClip);
element("token-form").addEventListener("submit", (event) => {
  event.preventDefault();
  setToken(element("token").value.trim());
  tokenSent = true;
  element("token").value = "";
  element("token-form").hidden = true;
  if (retry) run(retry);
});
window.addEventListener("resize", () => redraw(false)); // letters and lines stay readable
document.addEventListener("dragover", (event) => {
  event.preventDefault();
  document.body.classList.add("over");
});
document.addEventListener("dragleave", (event) => {
  if (!event.relatedTarget) document.body.classList.remove("over");
});
document.addEventListener("drop", (event) => {
  event.preventDefault();
  document.body.classList.remove("over");
  openFile(event.dataTransfer.files[0]);
});
document.addEventListener("paste", (event) => openFile(event.clipboardData.files[0]));

run(async () => {}); // only meet the service
