// The content of the page, and arrays from their packed form (packing.py).
const content = JSON.parse(document.getElementById("content").textContent);

// {shape, values} of a packed array; missing numbers are NaN.
function unpack(packed) {
  const bytes = Uint8Array.from(atob(packed.data), (one) => one.charCodeAt(0));
  if (packed.type === "f4") return { shape: packed.shape, values: new Float32Array(bytes.buffer) };
  const numbers = new Int16Array(bytes.buffer);
  const values = Float32Array.from(numbers, (one) => (one === -32768 ? NaN : one * packed.scale));
  return { shape: packed.shape, values };
}

// Rows of a packed matrix.
function unpackRows(packed) {
  const { shape, values } = unpack(packed);
  return Array.from({ length: shape[0] }, (_, i) => values.subarray(i * shape[1], (i + 1) * shape[1]));
}

// The case without errors, else the first: what others are compared with.
function referenceCase() {
  const without = content.cases.findIndex((one) => one.errors.every((error) => !error[1]));
  return Math.max(without, 0);
}

// Whether the numbers of a case are not those of a complete run.
function hasFailed(entry) {
  return Boolean(entry && entry.status && entry.status !== "ok");
}

// Name of a case where its numbers are shown: with an asterisk where it has failed.
function shownCase(name) {
  return hasFailed(content.cases.find((one) => one.name === name)) ? `${name}*` : name;
}

// What the asterisks mean, for each case that has failed; null where none has.
function failedNote(cases = content.cases) {
  const bad = cases.filter(hasFailed);
  return bad.length ? make("p", { class: "hint failed" }, bad.map((one) => `* ${one.name}: ${one.status}`).join("; "), ".") : null;
}

function jointOf(entry, name) {
  return entry.joints.find((joint) => joint.name === name) || {};
}

// The largest number of a joint metric over all cases.
function largestMetric(metric) {
  const sizes = content.cases.flatMap((one) => one.joints.map((joint) => joint[metric]));
  return Math.max(0, ...sizes.filter(Number.isFinite));
}

// The largest change from the reference case by errors, of complete runs: {case, joint, metric, from, to}, or null.
function largestChange(metric) {
  const reference = content.cases[referenceCase()];
  let found = null;
  content.cases.forEach((one, index) => {
    for (const joint of one.joints) {
      const from = jointOf(reference, joint.name)[metric];
      const to = joint[metric];
      if (!Number.isFinite(from) || !Number.isFinite(to) || one === reference || hasFailed(one)) continue;
      if (!found || to - from > found.to - found.from) found = { case: index, joint: joint.name, metric, from, to };
    }
  });
  return found;
}

// The case that errors load most.
function worstCase() {
  const metric = largestMetric("rms_moment") > 0 ? "rms_moment" : "rms_force";
  const found = largestChange(metric);
  return found ? found.case : content.cases.length - 1;
}
