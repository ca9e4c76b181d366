// Talks to the service: one place for the token, for refusals and for waiting when the service is busy.

let token = "";

export function setToken(value) {
  token = value;
}

/** A refusal of the service, or no answer at all. `status` is 0 when there was none. */
export class ServiceError extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
    this.wait = 1;
  }
}

async function ask(path, options = {}) {
  const headers = token ? { authorization: `Bearer ${token}` } : {};
  let answer;
  try {
    answer = await fetch(path, { ...options, headers: { ...headers, ...options.headers } });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new ServiceError(0, "The service does not answer. Is it still running?");
  }
  if (answer.ok) return answer.json();
  let message = `The service answered ${answer.status}.`;
  try {
    message = (await answer.json()).error.message;
  } catch {
    // not one of the service's own answers: the status says it all
  }
  const error = new ServiceError(answer.status, sentence(message));
  error.wait = Number(answer.headers.get("retry-after")) || 1;
  throw error;
}

export function capital(text) {
  return `${text.charAt(0).toUpperCase()}${text.slice(1)}`;
}

export function plural(name) {
  return `${name}${/(s|x|ch|sh)$/.test(name) ? "es" : "s"}`;
}

function sentence(text) {
  return `${capital(text)}${/[.!?]$/.test(text) ? "" : "."}`;
}

async function patiently(path, options) {
  for (let attempt = 0; ; attempt += 1) {
    try {
      return await ask(path, options);
    } catch (error) {
      if (error.status !== 503 || attempt === 4) throw error;
      await pause(1000 * error.wait, options.signal);
    }
  }
}

export function pause(milliseconds, signal) {
  return new Promise((resolve, reject) => {
    signal?.throwIfAborted();
    const stop = () => {
      clearTimeout(timer);
      reject(new DOMException("stopped", "AbortError"));
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener("abort", stop); // a camera waits a million times by one signal
      resolve();
    }, milliseconds);
    signal?.addEventListener("abort", stop, { once: true });
  });
}

export async function getModel() {
  return (await ask("v1/models")).models[0];
}

/** See one picture (a Blob). All boxes come, also unsure ones: the slider chooses. `roundTrip` is that of the request. */
export async function predict(blob, floor, signal) {
  const started = performance.now();
  const result = await patiently(`v1/predict?confidence=${floor}`, {
    method: "POST",
    body: blob,
    headers: { "content-type": blob.type || "application/octet-stream" },
    signal,
  });
  return { ...result, roundTrip: performance.now() - started, together: 1 };
}

/** Whether a refusal says that less must be sent at once: it was too large, or too slow on its way. */
export function isTooMuch(error) {
  return error instanceof ServiceError && [408, 413].includes(error.status);
}

/** See several pictures in one request; those for which there was no time are asked for again, and they alone. */
export async function predictBatch(blobs, floor, signal) {
  const started = performance.now();
  const results = [];
  let left = [...blobs.keys()];
  for (let idle = 0; left.length; ) {
    const form = new FormData();
    for (const index of left) form.append("images", blobs[index]);
    const answer = await patiently(`v1/predict/batch?confidence=${floor}`, { method: "POST", body: form, signal });
    left.forEach((index, place) => (results[index] = answer.results[place]));
    const busy = left.filter((index) => results[index].status === 503);
    idle = busy.length < left.length ? 0 : idle + 1;
    if (idle === 5) throw new ServiceError(503, sentence(results[busy[0]].error.message));
    left = busy;
    if (left.length) await pause(1000, signal);
  }
  const roundTrip = performance.now() - started;
  return results.map((result) => {
    if (result.status !== 200) throw new ServiceError(result.status, sentence(result.error.message));
    return { ...result, roundTrip, together: blobs.length };
  });
}
