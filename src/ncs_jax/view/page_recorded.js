// Animations that were stored, one for each motion alpha: shown one by one, or all side by side.
const usual = Math.max(0, scene.labels.indexOf("1")), tracks = [];
const together = scene.labels.length > 1 ? scene.labels.length : -1;  // the choice after the last: all of them side by side
let bodyTrack = null;
state.alpha = together > 0 && !narrow.matches ? together : usual;
const shown = () => state.alpha === together ? scene.labels.map((_, i) => i) : [state.alpha];
const choose = alpha => { if (alpha < scene.labels.length || alpha === together) state.alpha = alpha; show(); };
const grab = () => false, drag = () => false, release = () => {}, decorate = () => {};  // nothing but the camera is dragged

function readPlayer(query) {
  const label = [...scene.labels, "all"].indexOf(query.get("alpha"));
  if (label >= 0 && label <= Math.max(scene.labels.length - 1, together)) state.alpha = label;
}

async function load(garment, body) {
  for (const [i, record] of scene.garment.tracks.entries()) tracks.push(await unpackTrack("track-" + i, garment.verts, record));
  if (body) bodyTrack = await unpackTrack("track-body", body.verts, scene.body.tracks[0]);
  place = survey(tracks[usual], bodyTrack || tracks[usual]);
}
const poseBody = body => pose(body, bodyTrack, state.frame), poseGarment = (garment, which) => pose(garment, tracks[which], state.frame);

function advance(seconds) {
  if (!state.playing) return;
  state.frame += seconds * scene.fps * state.speed;
  if (state.loop) state.frame %= frames;  // the last frame stands for its own moment, then comes the first
  else if (state.frame >= last) { state.frame = last; setPlaying(false); }
  posed = false;
}

function showPlayer() {
  for (const [i, button] of [...document.querySelectorAll("#alphas button")].entries()) button.setAttribute("aria-pressed", i === state.alpha);
  $("panes").hidden = state.alpha !== together;
}

function connectPlayer() {
  $("scrub").max = last;
  if (together < 0) { $("help-alpha").hidden = true; return; }
  [...scene.labels, "all"].forEach((label, i) => {
    const button = document.createElement("button");
    button.textContent = label;
    button.setAttribute("aria-label", i === together ? "every motion α, side by side" : "motion α " + label);
    button.onclick = () => choose(i);
    document.querySelector("#alphas .segments").append(button);
    if (i === together) return;
    const name = document.createElement("span");
    name.textContent = "α = " + label;
    $("panes").append(name);
  });
  $("alphas").hidden = false;
}

function pressPlayer(key) {
  if (!(key >= "1" && key <= "9")) return false;
  choose(key - 1);
  return true;
}
