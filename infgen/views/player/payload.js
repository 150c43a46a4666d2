// Reading what Python packed: base64 -> inflate -> byte planes -> columns -> a film.

const READERS = { int8: Int8Array, int16: Int16Array, int32: Int32Array };

/**
 * Read a film from the text of the page.
 * @param {string} text base64 of a deflated payload
 */
export async function readFilm(text) {
  const bytes = await inflate(text);
  const { about, columns } = readColumns(bytes);
  return {
    ...about,
    map: readMap(columns, about.perM),
    lights: readLights(columns, about),
    showings: about.showings.map((each, at) => readShowing(each, columns, `${at}.`, about)),
  };
}

async function inflate(text) {
  const packed = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function readColumns(bytes) {
  const length = new DataView(bytes.buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
  const columns = new Map();
  let at = 4 + length;
  for (const [name, kind, count] of header.columns) {
    const values = new READERS[kind](count);
    gatherPlanes(values, bytes.subarray(at, at + values.byteLength));
    columns.set(name, values);
    at += values.byteLength;
  }
  return { about: header.about, columns };
}

/** The low bytes of all values come first, then the next ones. */
function gatherPlanes(values, planes) {
  const size = values.BYTES_PER_ELEMENT;
  const count = values.length;
  for (let at = 0; at < count; at++) {
    let value = 0;
    for (let byte = 0; byte < size; byte++) value |= planes[byte * count + at] << (8 * byte);
    values[at] = value; // A typed array keeps the low bits, sign included.
  }
}

function sums(values, scale) {
  const found = new Float32Array(values.length);
  let total = 0;
  for (let at = 0; at < values.length; at++) {
    total += values[at];
    found[at] = total / scale;
  }
  return found;
}

function readMap(columns, perM) {
  const lengths = columns.get("map.length");
  const offsets = new Int32Array(lengths.length + 1);
  for (let line = 0; line < lengths.length; line++) {
    offsets[line + 1] = offsets[line] + lengths[line];
  }
  return {
    look: columns.get("map.look"),
    bridge: columns.get("map.bridge"),
    offsets,
    x: sums(columns.get("map.x"), perM),
    y: sums(columns.get("map.y"), perM),
  };
}

function readLights(columns, about) {
  return {
    steps: about.lightSteps,
    x: sums(columns.get("lights.x"), about.perM),
    y: sums(columns.get("lights.y"), about.perM),
    heading: Float32Array.from(columns.get("lights.heading"), (h) => h / about.perRad),
    state: columns.get("lights.state"),
  };
}

function readShowing(each, columns, prefix, about) {
  const own = (name) => columns.get(prefix + name);
  const metres = (name) => Float32Array.from(own(name), (cm) => cm / about.perM);
  const showing = {
    ...each,
    id: own("id"),
    kind: own("agent_type"),
    role: own("role"),
    length: metres("length"),
    width: metres("width"),
    last: own("last"),
    x: decodeTracks(each, own, "x", about.perM),
    y: decodeTracks(each, own, "y", about.perM),
    heading: decodeTracks(each, own, "h", about.perRad),
    there: findThere(each, own),
  };
  return { ...showing, ...countAgents(showing, about.now) };
}

/** Second differences, run by run, to values; headings stay unwrapped within a run. */
function decodeTracks(each, own, axis, scale) {
  const found = new Float32Array(each.agents * each.steps);
  const change = own(`change.${axis}`);
  let from = 0;
  forEachRun(own, (run, cell, length) => {
    let value = own(`run.${axis}`)[run];
    let speed = 0;
    for (let at = 0; at < length; at++) {
      speed += change[from + at];
      value += speed;
      found[cell(each.steps) + at] = value / scale;
    }
    from += length;
  });
  return found;
}

function findThere(each, own) {
  const there = new Uint8Array(each.agents * each.steps);
  forEachRun(own, (run, cell, length) => {
    const first = cell(each.steps);
    there.fill(1, first, first + length);
  });
  return there;
}

function forEachRun(own, take) {
  const [agent, step, length] = ["agent", "step", "length"].map((name) => own(`run.${name}`));
  for (let run = 0; run < agent.length; run++) {
    take(run, (steps) => agent[run] * steps + step[run], length[run]);
  }
}

function running(values) {
  let total = 0;
  return values.map((value) => (total += value));
}

/** First step of everyone, and how many are there, come and go at every step. */
function countAgents(showing, now) {
  const { agents, steps, there, last } = showing;
  const first = new Int16Array(agents).fill(steps);
  const present = new Int16Array(steps);
  const entries = new Int16Array(steps);
  const exits = new Int16Array(steps);
  for (let row = 0; row < agents; row++) {
    for (let step = steps - 1; step >= 0; step--) {
      if (!there[row * steps + step]) continue;
      present[step]++;
      first[row] = step;
    }
    // Who comes or goes in the history is no doing of the rollout.
    if (first[row] > now && first[row] < steps) entries[first[row]]++;
    if (last[row] >= now && last[row] < steps) exits[last[row]]++;
  }
  return { first, present, entries, exits, entered: running(entries), left: running(exits) };
}
