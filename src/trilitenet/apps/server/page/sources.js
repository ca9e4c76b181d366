// Where pictures come from: a file, a clip frame by frame, the camera. Each becomes JPEG bytes and an ImageBitmap.

import { pause } from "./client.js";

const LONGEST = { photo: 2560, clip: 1280, camera: 960 };
const LARGEST_UPLOAD = 8 * 2 ** 20;
const SENT_AS_IS = ["image/jpeg", "image/png", "image/webp"];
const MOST_FRAMES = 300;

/**
 * Return { blob, picture } of a photo; the bytes are sent as they are unless they are huge or of another format.
 * Here and below `limits` has what the service takes: max_pixels and max_side of a picture, max_body of its bytes.
 */
export async function openPhoto(file, limits) {
  let picture;
  try {
    picture = await createImageBitmap(file);
  } catch {
    return { blob: file, picture: null }; // the service says what is wrong with it
  }
  const { width, height } = picture;
  const within = { ...limits, max_body: Math.min(LARGEST_UPLOAD, limits.max_body) };
  const fits = scaleTo(width, height, LONGEST.photo, within) === 1 && file.size <= within.max_body;
  if (SENT_AS_IS.includes(file.type) && !(await mayBeTurned(file)) && fits) return { blob: file, picture };
  try {
    return await shrink(picture, width, height, LONGEST.photo, 0.92, within);
  } finally {
    picture.close();
  }
}

/** By how much a picture must be made smaller, 1 if not at all. */
function scaleTo(width, height, longest, { max_pixels, max_side }) {
  const side = Math.min(longest, max_side, max_pixels) / Math.max(width, height);
  return Math.min(1, side, Math.sqrt(max_pixels / (width * height)));
}

/** Whether EXIF may turn a WebP: the service does so, browsers do not, and what is shown must be what is seen. */
async function mayBeTurned(file) {
  if (file.type !== "image/webp") return false;
  const [flags] = new Uint8Array(await file.slice(20, 21).arrayBuffer());
  return Boolean(flags & 8);
}

/** Draw a source no larger than `longest` and the limits, and return { blob, picture }. */
async function shrink(source, width, height, longest, quality, limits) {
  const canvas = document.createElement("canvas");
  const reduced = (side, scale) => Math.max(1, Math.floor(side * scale + 1e-6)); // rounded up it could be too large again
  for (let scale = scaleTo(width, height, longest, limits); ; ) {
    canvas.width = reduced(width, scale);
    canvas.height = reduced(height, scale);
    canvas.getContext("2d").drawImage(source, 0, 0, canvas.width, canvas.height);
    const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/jpeg", quality));
    const excess = blob.size / limits.max_body;
    if (excess <= 1 || canvas.width * canvas.height === 1) return { blob, picture: await createImageBitmap(canvas) };
    if (quality > 0.75) quality = 0.75; // which costs less than fewer pixels
    else scale *= Math.max(0.5, 0.95 / Math.sqrt(excess));
  }
}

function once(target, event, signal) {
  const over = new AbortController(); // takes all listeners away, that of the signal too
  return new Promise((resolve, reject) => {
    signal?.throwIfAborted(); // a signal that has gone off already tells nobody again
    const listening = { once: true, signal: over.signal };
    target.addEventListener(event, resolve, listening);
    target.addEventListener("error", () => reject(new Error("This clip cannot be played here.")), listening);
    signal?.addEventListener("abort", () => reject(new DOMException("stopped", "AbortError")), listening);
  }).finally(() => over.abort());
}

/** Yield { blob, picture, index, count, time, seconds } for frames of a clip `seconds` long, `rate` a second. */
export async function* openClip(file, rate, limits, signal) {
  const video = document.createElement("video");
  video.muted = true;
  video.playsInline = true;
  video.preload = "auto";
  const url = URL.createObjectURL(file);
  try {
    video.src = url;
    await once(video, "loadeddata", signal);
    if (!Number.isFinite(video.duration)) {
      // A clip recorded by a browser tells its length only after a jump to its end.
      video.currentTime = 1e9;
      await once(video, "seeked", signal);
    }
    const count = Math.min(MOST_FRAMES, Math.max(1, Math.floor(video.duration * rate)));
    for (let index = 0; index < count; index += 1) {
      const time = index / rate;
      const seeked = once(video, "seeked", signal);
      video.currentTime = time + 1e-3;
      await seeked;
      const frame = await shrink(video, video.videoWidth, video.videoHeight, LONGEST.clip, 0.88, limits);
      yield { ...frame, index, count, time, seconds: video.duration };
    }
  } finally {
    video.removeAttribute("src");
    video.load();
    URL.revokeObjectURL(url);
  }
}

/** Yield { blob, picture } from the camera, as fast as they are asked for. */
export async function* openCamera(limits, signal) {
  if (!navigator.mediaDevices) throw new Error("The camera needs a secure page: https, or this machine itself.");
  let stream;
  try {
    stream = await navigator.mediaDevices.getUserMedia({
      video: { facingMode: "environment", width: { ideal: 1280 }, height: { ideal: 720 } },
    });
  } catch (error) {
    const reasons = { NotAllowedError: "The camera was not allowed.", NotFoundError: "There is no camera." };
    throw new Error(reasons[error.name] ?? `The camera cannot be used (${error.name}).`);
  }
  const video = document.createElement("video");
  video.muted = true;
  video.playsInline = true;
  try {
    video.srcObject = stream;
    await video.play();
    while (!signal.aborted) {
      if (stream.getVideoTracks().every((track) => track.readyState === "ended")) throw new Error("The camera is gone.");
      if (video.videoWidth) yield await shrink(video, video.videoWidth, video.videoHeight, LONGEST.camera, 0.85, limits);
      await pause(15, signal);
    }
  } finally {
    for (const track of stream.getTracks()) track.stop();
    video.srcObject = null;
  }
}
