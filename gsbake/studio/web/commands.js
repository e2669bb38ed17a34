// The commands that buttons stand for, as one types them in the folder of captures.
const stored = (capture) => (capture.stored ? [] : [capture.source]);

export const check = (capture) => ["gsbake", "check", capture.source];
export const run = (capture, stage = "run") => ["gsbake", stage, ...stored(capture), "--out", capture.out];
export const settings = (capture, ...flags) => ["gsbake", "settings", ...stored(capture), "--out", capture.out, ...flags];
export const set = (capture, key, value) => settings(capture, "--set", `${key}=${typeof value === "string" ? value : JSON.stringify(value)}`);
export const unset = (capture, key) => settings(capture, "--unset", key);
export const target = (capture, names) => ["gsbake", "targets", "--out", capture.out, "--target", names.join(",")];
export const compare = (first, second) => ["gsbake", "compare", `${first.out}/asset.glb`, `${second.out}/asset.glb`];
export const leaveOut = (capture, names) => (names.length ? settings(capture, ...names.flatMap((name) => ["--leave-out", name])) : unset(capture, "ingest.leave_out"));
