// A trained network, run here: motions, alpha, and joints that are dragged. ONNX Runtime Web runs the step that is in the page.
const RELAXING = 0.3, TURN = 0.25, MOVE = 0.05;  // of a dragged pose in a step: the share, and at most, radians and m
const NEAR = 26, CATCH_UP = 4;                   // pixels from a joint that is grabbed; steps in a picture, at most
const STATES = 16e6;                             // numbers of states that are kept, so that going back is quick
const { skeleton, motions, steps, turned } = scene.live, joints = skeleton.parents.length;
const now = { poses: null, translation: null, track: null, refined: null };  // of the motion that is shown
const sim = { at: -1, kept: [], every: 1, inputs: [], shown: [], u: 1, debt: 0, stale: false, cost: 0 };
const edits = { wanted: new Map(), reached: new Map(), moveWanted: [0, 0, 0], moveReached: [0, 0, 0], held: null };
let ort, sessions, skinner, bodyRest;
Object.assign(state, { motion: 0, alpha: 1, compare: false, posing: false });

/** What is shown side by side: the network at an alpha, or what was stored of the refinement. */
function shown() {
  if (!state.compare) return [{ alpha: state.alpha, name: "" }];
  const still = scene.live.controlled ? [{ alpha: 0, name: "α = 0" }] : [];
  const refined = now.refined && !edited() ? [{ refined: true, name: motions[state.motion].refined.name }] : [];
  return [...still, { alpha: state.alpha, name: scene.live.controlled ? "α = " + state.alpha.toFixed(2) : "network" }, ...refined];
}
const edited = () => edits.wanted.size > 0 || edits.moveWanted.some(x => x);

// -- Rotations: matrices by rows in flat arrays ---------------------------------------------------------------------------
const EYE = [1, 0, 0, 0, 1, 0, 0, 0, 1];
const times = (a, b) => Array.from({ length: 9 }, (_, i) => { const r = 3 * (i / 3 | 0), c = i % 3; return a[r] * b[c] + a[r + 1] * b[3 + c] + a[r + 2] * b[6 + c]; });
const flipped = a => [a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8]];
const turn = (a, v) => [0, 3, 6].map(r => a[r] * v[0] + a[r + 1] * v[1] + a[r + 2] * v[2]);
const plus = (a, b, share = 1) => a.map((x, c) => x + share * b[c]);

function rotation([x, y, z]) {  // of an axis times an angle
  const angle = Math.hypot(x, y, z);
  if (angle < 1e-12) return [1, -z, y, z, 1, -x, -y, x, 1];
  const s = Math.sin(angle) / angle, c = (1 - Math.cos(angle)) / angle ** 2;
  return [1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y, c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
    c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)];
}

function axisAngle(a) {  // less than half a turn, as edits are
  const v = [a[7] - a[5], a[2] - a[6], a[3] - a[1]], s = Math.hypot(...v);
  return s < 1e-9 ? [0, 0, 0] : v.map(x => x / s * Math.atan2(s, a[0] + a[4] + a[8] - 1));
}

/** The turn of the least angle that takes one direction to another. */
function between(a, b) {
  const axis = cross(a, b), s = Math.hypot(...axis);
  return s < 1e-9 ? EYE : rotation(axis.map(x => x / s * Math.atan2(s, dot(a, b))));
}

// -- The character: its pose in a frame, and its skin ---------------------------------------------------------------------
/** Local rotations along the world's axes, world rotations, and places of the joints, m, in a frame with edits of the pose. */
function kinematics(frame, turns, move) {
  const local = [], world = [], places = [];
  for (let j = 0; j < joints; j++) {
    const i = 3 * (frame * joints + j), above = skeleton.parents[j], axes = skeleton.axes?.[j];
    let own = rotation(now.poses.subarray(i, i + 3));
    if (axes) own = times(times(axes, own), flipped(axes));
    if (turns.has(j)) own = times(turns.get(j), own);
    local.push(own);
    if (above < 0) {
      world.push(own);
      places.push([0, 1, 2].map(c => skeleton.joints[j][c] + now.translation[3 * frame + c] + move[c]));
    } else {
      world.push(times(world[above], own));
      places.push(plus(places[above], turn(world[above], plus(skeleton.joints[j], skeleton.joints[above], -1))));
    }
  }
  return { local, world, places };
}

/** Linear blend skinning of the body into the first of its vertices. */
function skinBody(pose, out) {
  const matrices = new Float64Array(12 * joints), { columns, weights, count } = skinner;
  for (let j = 0; j < joints; j++) {
    const shift = plus(pose.places[j], turn(pose.world[j], skeleton.joints[j]), -1);
    for (let r = 0; r < 3; r++) matrices.set([...pose.world[j].slice(3 * r, 3 * r + 3), shift[r]], 12 * j + 4 * r);
  }
  const m = new Float64Array(12);
  for (let v = 0, k = 0; 3 * v < bodyRest.length; v++) {
    m.fill(0);
    for (let end = k + count; k < end; k++) {
      const w = weights[k], at = 12 * columns[k];
      if (w) for (let i = 0; i < 12; i++) m[i] += w * matrices[at + i];
    }
    const x = bodyRest[3 * v], y = bodyRest[3 * v + 1], z = bodyRest[3 * v + 2];
    for (let r = 0; r < 3; r++) out[3 * v + r] = m[4 * r] * x + m[4 * r + 1] * y + m[4 * r + 2] * z + m[4 * r + 3];
  }
}

// -- The step -------------------------------------------------------------------------------------------------------------
/** Run the networks on a pose, from their states: the next states, and what is drawn, m. */
async function run(input, drawnToo = true) {
  const began = performance.now(), { states, pose, move } = input, next = [], out = { cloth: [], body: null };
  if (drawnToo && scene.body) skinBody(pose, out.body = new Float32Array(3 * scene.body.verts));
  const tensor = (data, shape) => new ort.Tensor("float32", data, shape);
  for (const [i, step] of steps.entries()) {
    const own = step.joints.flatMap(j => {
      const axes = skeleton.axes?.[j];  // the step takes them along the joints' own axes, as motions have them
      return axes ? times(times(flipped(axes), pose.local[j]), axes) : pose.local[j];
    });
    const alphas = i === 0 && drawnToo ? shown().filter(x => !x.refined).map(x => x.alpha) : [1];
    for (const alpha of alphas) {
      const result = await sessions[i].run({
        state: tensor(states[i], [step.state]), rotations: tensor(Float32Array.from(own), [step.joints.length, 3, 3]),
        translation: tensor(Float32Array.from(move), [3]), alpha: tensor(Float32Array.of(alpha), [1]),
      });
      next[i] = result.next_state.data;
      if (i === 0) out.cloth.push(result.vertices.data);
      else if (out.body) out.body.set(result.vertices.data, step.first);
    }
  }
  sim.cost = 0.95 * (sim.cost || performance.now() - began) + 0.05 * (performance.now() - began);
  return { next, out };
}

const fresh = () => steps.map(step => new Float32Array(step.state));
const posedAt = (frame, turns = edits.reached, moved = edits.moveReached) => ({
  pose: kinematics(frame, turns, moved), move: [0, 1, 2].map(c => now.translation[3 * frame + c] + moved[c]),
});

/** Take one step in time, in the pose of a frame; of `drawnToo` false only the states are of use. */
async function stepOnce(frame, states, drawnToo = true) {
  relax();
  const input = { states, ...posedAt(frame) }, { next, out } = await run(input, drawnToo);
  sim.inputs = [...sim.inputs.slice(-1), input];
  sim.next = next;
  if (drawnToo) sim.shown = [sim.shown[1] || out, out];
}

/** Go to a frame of the motion, from the frame before, or from the nearest before it of which the state is known. */
async function reach(frame) {
  if (frame === sim.at) return;
  if (frame !== sim.at + 1 || sim.at < 0) {
    let from = Math.min(Math.floor(Math.max(frame - 1, 0) / sim.every), sim.kept.length - 1);
    if (sim.at >= 0 && sim.at < frame && sim.at + 1 > from * sim.every) from = -1;  // it is on the way
    else sim.at = from >= 0 ? from * sim.every - 1 : -1;
    if (from >= 0) sim.next = sim.kept[from];
    else if (sim.at < 0) sim.next = fresh();
  }
  for (let f = sim.at + 1; f <= frame; f++) {
    if (f === 0) sim.shown = [];
    if (f % sim.every === 0 && sim.kept.length === f / sim.every && !edited()) sim.kept.push(sim.next);
    await stepOnce(f, sim.next, f >= frame - 1);
    sim.at = f;
  }
}

/** Show the last two steps again, with another alpha or beside others. */
async function again() {
  const outs = [];
  for (const input of sim.inputs) outs.push((await run(input)).out);
  sim.shown = [outs[0], outs[outs.length - 1]];
  sim.stale = false;
}

/** Bring the pose nearer to what it is dragged to, no faster than cloth bears. */
function relax() {
  for (const [j, wanted] of edits.wanted) {
    const reached = edits.reached.get(j) || EYE, way = axisAngle(times(wanted, flipped(reached))), angle = Math.hypot(...way);
    const share = angle < 1e-4 ? 1 : Math.min(RELAXING, TURN / angle);
    edits.reached.set(j, times(rotation(way.map(x => share * x)), reached));
    if (wanted === EYE && angle < 1e-4) edits.wanted.delete(j), edits.reached.delete(j);
  }
  const way = plus(edits.moveWanted, edits.moveReached, -1), length = Math.hypot(...way);
  edits.moveReached = length < 1e-5 ? [...edits.moveWanted] : plus(edits.moveReached, way, Math.min(RELAXING, MOVE / length));
}

const relaxed = () => edits.moveReached.every((x, c) => x === edits.moveWanted[c]) &&
  [...edits.wanted].every(([j, wanted]) => Math.hypot(...axisAngle(times(wanted, flipped(edits.reached.get(j) || EYE)))) < 1e-3);

let busy = Promise.resolve();  // who uses the networks: one at a time
const alone = work => busy = busy.then(work);

const advance = seconds => alone(async () => {
  const held = !state.playing && (state.posing || !relaxed());
  if (held) {  // the motion stands, time goes on
    sim.kept = [];
    sim.debt = Math.min(sim.debt + seconds * scene.fps * state.speed, CATCH_UP);
    const frame = Math.min(Math.round(state.frame), last);
    if (sim.at !== frame) await reach(frame);
    for (; sim.debt >= 1; sim.debt--) await stepOnce(frame, sim.next);
    sim.u = sim.debt, sim.stale = posed = false;
    return;
  }
  if (state.playing) {
    state.frame += seconds * scene.fps * state.speed;
    if (state.loop && state.frame >= frames) state.frame %= frames, sim.at = -1;
    else if (!state.loop && state.frame >= last) { state.frame = last; setPlaying(false); }
    if (edited()) sim.kept = [];
    posed = false;
  }
  if (posed && !sim.stale) return;
  const frame = Math.min(Math.ceil(state.frame), last);
  if (frame !== sim.at) await reach(frame), sim.stale = false;
  if (sim.stale) await again();
  sim.u = state.frame > last ? 1 : 1 - (frame - state.frame);
  posed = false;
});

// -- What is drawn: between the last two steps ------------------------------------------------------------------------------
function mix(mesh, [a, b]) {
  const p = mesh.positions, u = sim.u;
  for (let i = 0; i < p.length; i++) p[i] = a[i] + u * (b[i] - a[i]);
  if (turned) for (let i = 0; i < p.length; i += 3) p.set(turn(turned, p.subarray(i, i + 3)), i);
  shade(mesh);
}
const poseBody = body => mix(body, sim.shown.map(out => out.body));

function poseGarment(garment, which) {
  if (which.refined) return pose(garment, now.refined, Math.min(state.frame, last));
  const place = shown().filter(x => !x.refined).findIndex(x => x.name === which.name);
  mix(garment, sim.shown.map(out => out.cloth[place] || out.cloth[0]));
}

// -- Joints that are dragged ----------------------------------------------------------------------------------------------
const upright = p => turned ? turn(turned, p) : p, lying = p => turned ? turn(flipped(turned), p) : p;
const pane = () => { const all = shown(); return { wide: canvas.clientWidth / all.length, left: canvas.clientWidth / all.length * (state.compare && scene.live.controlled ? 1 : 0) }; };

/** Where a place, m, is seen: pixels of the window, and whether it is before the camera. */
function project(p) {
  const d = plus(upright(p), eye.at, -1), away = -dot(eye.away, d), f = 1 / Math.tan(FOV / 2), { wide, left } = pane(), high = canvas.clientHeight;
  const x = f * high / wide * dot(eye.side, d) / away, y = f * dot(eye.up, d) / away + eye.shift;
  return [left + (x + 1) * wide / 2, (1 - y) * high / 2, away > 0];
}

/** The direction from the eye, in the axes of the character, through a pixel. */
function ray(x, y) {
  const f = 1 / Math.tan(FOV / 2), { wide, left } = pane(), high = canvas.clientHeight;
  const right = ((x - left) / wide * 2 - 1) * wide / high / f, up = (1 - 2 * y / high - eye.shift) / f;
  return lying(unit([0, 1, 2].map(c => eye.side[c] * right + eye.up[c] * up - eye.away[c])));
}

const wantedPose = () => kinematics(Math.min(Math.round(state.frame), last), edits.wanted, edits.moveWanted);

function showHandles() {
  const holder = $("handles");
  holder.hidden = !state.posing;
  if (!state.posing) return;
  const frame = Math.min(Math.round(state.frame), last), { places } = kinematics(frame, edits.reached, edits.moveReached);
  for (const [j, handle] of [...holder.children].entries()) {
    const [x, y, before] = project(places[j]);
    handle.style.transform = before ? `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)` : "translate(-99px, 0)";
    handle.classList.toggle("held", edits.held?.joint === j);
  }
}

/** The nearest joint above one that is apart from it, about which its bone turns; -1 of the root. */
function pivot(j) {
  let above = skeleton.parents[j];
  while (above >= 0 && Math.hypot(...plus(skeleton.joints[j], skeleton.joints[above], -1)) < 0.01) above = skeleton.parents[above];
  return above;
}

/** Turn a joint by a turn along the world's axes, on top of how it is dragged already. */
function turnJoint(j, by, { world }) {
  const above = skeleton.parents[j] < 0 ? EYE : world[skeleton.parents[j]];
  edits.wanted.set(j, times(times(flipped(above), times(by, above)), edits.wanted.get(j) || EYE));
}

function grab(event) {
  if (!state.posing || event.button) return false;
  const { places } = wantedPose();
  let nearest = NEAR, joint = -1;
  places.forEach((p, j) => {
    const [x, y, before] = project(p), far = Math.hypot(x - event.clientX, y - event.clientY);
    if (before && far < nearest) nearest = far, joint = j;
  });
  if (joint < 0) return false;
  edits.held = { joint, pointer: event.pointerId, x: event.clientX, y: event.clientY };
  $("unpose").hidden = false;
  return true;
}

function drag(event) {
  const { held } = edits;
  if (!held || held.pointer !== event.pointerId) return Boolean(held);
  const dx = event.clientX - held.x, dy = event.clientY - held.y, found = wantedPose(), above = pivot(held.joint);
  Object.assign(held, { x: event.clientX, y: event.clientY });
  if (event.shiftKey) {  // about the view's upright and level axes
    const [side, up] = [eye.side, eye.up].map(lying);
    turnJoint(held.joint, rotation(plus(up.map(x => 0.01 * dx * x), side, 0.01 * dy)), found);
  } else if (above < 0) {
    const [side, up] = [eye.side, eye.up].map(lying);
    edits.moveWanted = plus(plus(edits.moveWanted, side, dx * eye.perPixel), up, -dy * eye.perPixel);
  } else {
    // Where the line of sight meets the sphere that the bone reaches, on the side where the joint is; else the nearest of it.
    const at = found.places[held.joint], from = found.places[above], bone = plus(at, from, -1), d = ray(event.clientX, event.clientY);
    const start = plus(lying(eye.at), from, -1), along = -dot(start, d), beside = plus(start, d, along);
    const inside = dot(bone, bone) - dot(beside, beside), half = Math.sqrt(Math.max(inside, 0));
    const ends = [-half, half].map(t => plus(beside, d, t)), far = p => Math.hypot(...plus(p, bone, -1));
    turnJoint(above, between(unit(bone), unit(far(ends[0]) <= far(ends[1]) ? ends[0] : ends[1])), found);
  }
  posed = false;
  return true;
}

function release(event) { if (edits.held?.pointer === event.pointerId) edits.held = null; }

function unpose() {
  for (const j of edits.wanted.keys()) edits.wanted.set(j, EYE);
  edits.moveWanted = [0, 0, 0];
  $("unpose").hidden = true;
  show();
}

// -- Motions --------------------------------------------------------------------------------------------------------------
/** Numbers that were stored as second differences in time of whole steps, their bytes by place: see `view.living`. */
async function unpackNumbers(id, count, step) {
  const bytes = await unpack(id), out = new Float64Array(bytes.length / 4), rows = out.length / count;
  for (let k = 0; k < count; k++) {
    for (let f = 0, speed = 0, at = 0; f < rows; f++) {
      const i = f * count + k, n = out.length;
      at += speed += (bytes[i] | bytes[n + i] << 8 | bytes[2 * n + i] << 16 | bytes[3 * n + i] << 24);
      out[i] = step * at;
    }
  }
  return out;
}

async function chooseMotion(number) {
  const motion = motions[number];
  motion.numbers ||= await unpackNumbers("motion-" + number, 3 * joints + 3, scene.live.step);
  if (motion.refined) motion.refined.track ||= await (frames = motion.frames, unpackTrack("refined-" + number, scene.garment.verts, motion.refined));
  frames = motion.frames, last = frames - 1;
  now.poses = new Float64Array(3 * joints * frames), now.translation = new Float64Array(3 * frames);
  for (let f = 0; f < frames; f++) {
    const row = motion.numbers.subarray(f * (3 * joints + 3), (f + 1) * (3 * joints + 3));
    now.poses.set(row.subarray(0, 3 * joints), f * 3 * joints), now.translation.set(row.subarray(3 * joints), 3 * f);
  }
  now.refined = motion.refined?.track;
  const size = steps.reduce((sum, step) => sum + step.state, 0);
  Object.assign(sim, { at: -1, kept: [], every: Math.ceil(frames * size / STATES), inputs: [], shown: [], stale: false, debt: 0 });
  motion.place ||= await surveyed();
  place = motion.place;
  state.motion = number, state.frame = Math.min(state.frame, last);
  $("scrub").max = last;
}

/** Where the character goes in the motion, as `survey` reads it: its skin, a third of which will do, or the cloth alone. */
async function surveyed() {
  const box = new Float32Array(6 * frames).fill(-Infinity), middle = new Float32Array(3 * frames);
  const skin = bodyRest && new Float32Array(bodyRest.length), stride = skin ? 9 : 3;
  for (let f = 0, states = fresh(); f < frames; f++) {
    const input = { states, ...posedAt(f, new Map(), [0, 0, 0]) }, sum = [0, 0, 0];
    let points = skin;
    if (skin) skinBody(input.pose, skin);
    else {
      const { next, out } = await run(input);
      states = next, points = out.cloth[0];
    }
    for (let i = 0; i < points.length; i += stride) {
      const p = upright([points[i], points[i + 1], points[i + 2]]);
      for (let c = 0; c < 3; c++) {
        sum[c] += p[c];
        box[6 * f + c] = Math.max(box[6 * f + c], -p[c]), box[6 * f + 3 + c] = Math.max(box[6 * f + 3 + c], p[c]);
      }
    }
    for (let c = 0; c < 3; c++) middle[3 * f + c] = sum[c] / Math.ceil(points.length / stride);
  }
  return survey({ box, middle }, { box, middle });
}

// -- Start, and controls ----------------------------------------------------------------------------------------------------
const addressOf = async (id, type) => URL.createObjectURL(new Blob([await unpack(id)], { type }));

async function load() {
  ort = await import(await addressOf("runtime-script", "text/javascript"));
  const [mjs, wasm] = [await addressOf("runtime-module", "text/javascript"), await addressOf("runtime-wasm", "application/wasm")];
  ort.env.wasm.wasmPaths = { mjs, wasm };
  ort.env.wasm.numThreads = 1, ort.env.wasm.proxy = false, ort.env.logLevel = "error";
  sessions = [];
  for (const step of steps) sessions.push(await ort.InferenceSession.create(unshuffled(await unpack(step.id), step.bytes), { executionProviders: ["wasm"] }));
  if (scene.body) {
    bodyRest = new Float32Array((await unpack("body-rest")).buffer);
    skinner = { columns: new Uint16Array((await unpack("body-joints")).buffer), weights: new Float32Array((await unpack("body-weights")).buffer), count: scene.body.influences };
  }
  await chooseMotion(state.motion);
}

/** The bytes of numbers of four, which were stored by place. */
function unshuffled(bytes, size) {
  const out = new Uint8Array(bytes.length), quarter = bytes.length / 4;
  for (let i = 0; i < quarter; i++) for (let k = 0; k < 4; k++) out[4 * i + k] = bytes[k * quarter + i];
  return out.subarray(0, size);
}

function readPlayer(query) {
  const motion = motions.findIndex(m => m.name === query.get("motion")), alpha = parseFloat(query.get("alpha"));
  if (motion >= 0 && now.poses && motion !== state.motion) alone(() => chooseMotion(motion)).then(show);
  else if (motion >= 0) state.motion = motion, last = motions[motion].frames - 1;
  if (Number.isFinite(alpha) && scene.live.controlled) state.alpha = clamp(alpha, 0, 2);
  for (const name of ["compare", "posing"]) if (query.has(name)) state[name] = !off(query.get(name));
}

function showPlayer() {
  const compare = shown();
  $("panes").hidden = compare.length < 2;
  $("panes").replaceChildren(...compare.map(({ name }) => Object.assign(document.createElement("span"), { textContent: name })));
  if (compare.length > 1) document.querySelector("details").open = false;
  $("alpha").value = state.alpha;
  $("alpha").style.setProperty("--at", 50 * state.alpha + "%");
  $("alpha-value").textContent = state.alpha.toFixed(2);
  $("motion").value = state.motion;
  $("handles").hidden = !state.posing;
  canvas.style.cursor = state.posing ? "default" : "";
  sim.stale = true;
}

function connectPlayer() {
  motions.forEach((motion, i) => $("motion").add(new Option(motion.name, i)));
  $("motion").onchange = event => alone(async () => { await chooseMotion(+event.target.value); state.frame = 0; }).then(show);
  $("alphas").hidden = !scene.live.controlled;
  $("alpha").oninput = event => { state.alpha = +event.target.value; show(); };
  $("unpose").onclick = unpose;
  if (!scene.live.controlled && !motions.some(m => m.refined)) document.querySelector("[data-toggle=compare]").hidden = true;
  const handles = Object.assign(document.createElement("div"), { id: "handles", hidden: true });
  handles.append(...skeleton.names.map(() => document.createElement("i")));
  canvas.after(handles);
  const row = document.createElement("div"), pace = document.createElement("dd");
  row.append(Object.assign(document.createElement("dt"), { textContent: "here" }), pace);
  document.querySelector("dl").append(row);
  setInterval(() => {
    pace.textContent = `${pictures} pictures a second; a step of the network takes ${sim.cost.toFixed(1)} ms`;
    pictures = 0;
  }, 1000);
}

let pictures = 0;
function decorate() { pictures++, showHandles(); }

function pressPlayer(key) {
  const alphas = { 1: 0, 2: 1, 3: 1.5, 4: 2 };
  if (key in alphas && scene.live.controlled) state.alpha = alphas[key], show();
  else if (key === "p") toggle("posing");
  else if (key === "c") toggle("compare");
  else if (key === "u") unpose();
  else return false;
  return true;
}

/** For tests, and for scripts around this page: garment and body in every frame of a motion, m, from its start. */
globalThis.ncs = {
  motions: motions.map(motion => motion.name),
  vertices: (name, alpha = 1) => alone(async () => {
    const before = state.motion, all = [];
    await chooseMotion(motions.findIndex(motion => motion.name === name));
    const kept = [state.alpha, state.compare];
    [state.alpha, state.compare] = [alpha, false];
    for (let f = 0, states = fresh(); f < frames; f++) {
      const { next, out } = await run({ states, ...posedAt(f, new Map(), [0, 0, 0]) });
      states = next, all.push([out.cloth[0], out.body].map(x => x && x.map((v, i) => v + motions[state.motion].start[i % 3])));
    }
    [state.alpha, state.compare] = kept;
    await chooseMotion(before);
    posed = false;
    return all;
  }),
};
