// Files on their way to a capture: one after the other in pieces, going on where they stopped.
import { at, enc, get, put } from "./api.js";
import { notice } from "./dom.js";
import { t } from "./strings.js";

const PIECE = 8 * 1024 * 1024;
const TRIES = 6;
const pause = (ms) => new Promise((done) => setTimeout(done, ms));

const send = async (capture, file, onbytes) => {
  const path = at(capture, "upload", enc(file.name));
  let { bytes: have, complete } = await get(path);
  if (complete) throw new Error(t.uploadFailed(file.name, "409"));
  if (have > file.size) throw new Error(t.uploadFailed(file.name, "409"));
  for (let tries = 0; have < file.size || tries === 0; ) {
    try {
      const found = await put(`${path}?offset=${have}&size=${file.size}`, file.slice(have, have + PIECE));
      have = found.bytes;
      onbytes(have / file.size);
      if (found.complete) return;
      tries = 0.5;
    } catch (error) {
      if (error.code || ++tries > TRIES) throw error;
      notice(t.resuming);
      await pause(1000 * tries);
      ({ bytes: have } = await get(path));
    }
  }
};

// Send files to a capture; `onprogress(text, share)`. Returns how many arrived; those that did not are named in notices.
export const upload = async (capture, files, onprogress) => {
  let arrived = 0;
  for (const [index, file] of [...files].entries()) {
    const text = t.uploading(file.name, index + 1, files.length);
    onprogress(text, index / files.length);
    try {
      await send(capture, file, (share) => onprogress(text, (index + share) / files.length));
      arrived += 1;
    } catch (error) {
      notice(t.uploadFailed(file.name, error.message), "bad");
    }
  }
  return arrived;
};
