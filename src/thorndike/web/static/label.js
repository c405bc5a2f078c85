// The labelling page. Items are fetched before they are needed, so that the next one is there at once. A judgement is kept in this browser
// until the server has said that it is on the disk; until then it is sent again, under the same name, so that it counts once.
import { element, letter, parts, showsSpaces, toggleSpaces } from "./label_content.js";

const AHEAD = 8;
const RETRY_MS = [200, 500, 1000, 2000, 4000];
const RATE_WINDOW_MS = 5 * 60 * 1000;
const $ = (id) => document.getElementById(id);
let rater = "";
let about = { project: "", guidelines: "" };
let queue = [];            // items to judge; the first is on the screen
let drawn = null;          // the item that is drawn
let drawnAt = 0;
let ranking = [];          // groups of places, the best first; for more than two candidates
let tieNext = false;
let outbox = [];           // what the server has not acknowledged yet, in order
let sending = false;
let fetching = null;
let exhausted = false;
let offline = false;
let counts = { own: 0, done: 0, items_in_all: 0 };
let times = [];            // of this session's judgements
const finished = new Set();  // assignments that were judged here: the server may not know yet

// ---- what must not be lost ----------------------------------------------------------------------------------------------------------

const prefix = () => `thorndike-label:${location.host}:${rater}:`;

function keep(entry) {
  localStorage.setItem(prefix() + entry.body.request, JSON.stringify(entry));
  outbox.push(entry);
  showSaved();
  send();
}

function restoreOutbox() {
  const found = [];
  for (let number = 0; number < localStorage.length; number += 1) {
    const key = localStorage.key(number);
    if (key.startsWith(prefix())) found.push(JSON.parse(localStorage.getItem(key)));
  }
  outbox = found.sort((one, other) => one.order - other.order);
  for (const entry of outbox) if (entry.path === "judge") finished.add(entry.body.assignment);
}

async function send() {
  if (sending) return;
  sending = true;
  for (let failures = 0; outbox.length;) {
    const entry = outbox[0];
    let answer = null;
    try {
      answer = await post(entry.path, entry.body);
    } catch {
      offline = true;
      showSaved();
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS[Math.min(failures, RETRY_MS.length - 1)]));
      failures += 1;
      continue;
    }
    failures = 0;
    localStorage.removeItem(prefix() + entry.body.request);
    outbox.shift();
    if (answer.error) say(answer.error);
    else if (entry.path === "undo") undone(answer.item);
    showSaved();
  }
  sending = false;
  if (queue.length < AHEAD - 2) more();
}

async function post(path, body) {
  const response = await fetch(`/label/${path}`, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) });
  if (response.status === 409 || response.status === 422) {
    const said = await response.json();
    return { error: said.error || "the server did not understand this page: reload it" };
  }
  if (!response.ok) throw new Error(`status ${response.status}`);
  offline = false;
  return response.json();
}

const request = () => `${Date.now().toString(36)}-${crypto.getRandomValues(new Uint32Array(3)).join("-")}`;

// ---- items --------------------------------------------------------------------------------------------------------------------------

function more() {
  fetching ??= fetchMore().finally(() => { fetching = null; });
  return fetching;
}

async function fetchMore() {
  for (let failures = 0; ; failures += 1) {
    let answer = null;
    // Those that are judged here but not there yet come, too: ask for as many more.
    const count = Math.min(20, AHEAD + outbox.length);
    try {
      answer = await post("next", { rater, count });
    } catch {
      offline = true;
      showSaved();
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS[Math.min(failures, RETRY_MS.length - 1)]));
      continue;
    }
    if (answer.error) { say(answer.error); return; }
    const known = new Set(queue.map((item) => item.assignment));
    const fresh = answer.items.filter((item) => !known.has(item.assignment) && !finished.has(item.assignment));
    queue.push(...fresh);
    fresh.forEach(prefetchClips);
    exhausted = answer.items.length < count && !outbox.length;
    showSaved();
    counts = { own: answer.own + outbox.filter((entry) => entry.path === "judge").length, done: answer.done, items_in_all: answer.items_in_all };
    showCounts();
    draw();
    return;
  }
}

function prefetchClips(item) {
  for (const candidate of item.candidates) {
    if (candidate.kind === "image") new Image().src = candidate.media;
    if (candidate.kind === "video") fetch(candidate.media).catch(() => undefined);
  }
}

function judge(verdict, ranks = null) {
  const item = queue[0];
  if (!item || item !== drawn) return;
  const chosen = document.querySelector('input[name="strength"]:checked');
  const body = {
    rater, assignment: item.assignment, verdict, ranks, request: request(), client: "label page 1",
    strength: chosen && verdict !== "skip" ? Number(chosen.value) : null, reason: $("reason").value,
    milliseconds: Math.min(Math.round(performance.now() - drawnAt), 7 * 86400000),
  };
  finished.add(item.assignment);
  queue.shift();
  times.push(performance.now());
  counts.own += 1;
  keep({ path: "judge", order: performance.timeOrigin + performance.now(), body });
  showCounts();
  speak(verdict, ranks);
  draw();
  if (queue.length < AHEAD - 2 && !exhausted) more();
}

function undo() {
  keep({ path: "undo", order: performance.timeOrigin + performance.now(), body: { rater, request: request() } });
}

function undone(item) {
  if (!item) { say("There is nothing to undo."); return; }
  say("");
  finished.delete(item.assignment);
  queue = [item, ...queue.filter((other) => other.assignment !== item.assignment)];
  times.pop();
  counts.own = Math.max(0, counts.own - 1);
  showCounts();
  $("spoken").textContent = "Undone. Judge it once more.";
  draw();
}

// ---- drawing ------------------------------------------------------------------------------------------------------------------------

function draw() {
  const item = queue[0] ?? null;
  if (item && item === drawn) return;
  drawn = item;
  $("work").hidden = !item;
  $("empty").hidden = Boolean(item);
  if (!item) return drawEmpty();
  ranking = [];
  tieNext = false;
  $("reason").value = "";
  document.querySelectorAll('input[name="strength"]').forEach((each) => { each.checked = false; });
  $("prompt").replaceChildren(...parts(item.prompt));
  $("candidates").className = item.candidates.length > 2 ? "candidates many" : "candidates";
  $("candidates").replaceChildren(...item.candidates.map((content, place) => card(item, content, place)));
  $("question").textContent = item.candidates.length > 2 ? "Put them in order, the best first" : "Which is better?";
  drawVerdicts(item.candidates.length);
  drawnAt = performance.now();
  document.body.dataset.assignment = item.assignment;
  $("question").focus({ preventScroll: true });
  window.scrollTo(0, 0);
}

function drawEmpty() {
  delete document.body.dataset.assignment;
  const waiting = !exhausted;
  $("empty-title").textContent = waiting ? "One moment…" : "That is all for now";
  $("empty-text").textContent = waiting ? "The next item is on its way." : "Thank you. There is nothing left that needs your judgement.";
  $("undo-last").hidden = waiting;
  $("again").hidden = waiting;
  if (!waiting) $("empty-title").focus();
}

function card(item, content, place) {
  const many = item.candidates.length > 2;
  const made = element("article", "candidate");
  made.setAttribute("aria-label", `Answer ${letter(place)}`);
  made.dataset.place = place;
  const heading = element("h2", "", many ? `${place + 1}` : letter(place));
  if (many) heading.append(element("span", "rank"));
  made.append(heading, ...parts(content, place));
  if (many) {
    made.draggable = true;
    made.addEventListener("dragstart", (event) => event.dataTransfer.setData("text/plain", String(place)));
    made.addEventListener("dragover", (event) => { event.preventDefault(); made.classList.add("over"); });
    made.addEventListener("dragleave", () => made.classList.remove("over"));
    made.addEventListener("drop", (event) => { event.preventDefault(); made.classList.remove("over"); dropped(Number(event.dataTransfer.getData("text/plain")), made); });
    made.addEventListener("click", () => { if (!getSelection().toString()) rankNext(place); });
  }
  return made;
}

function switchSpaces() {
  toggleSpaces();
  $("whitespace").setAttribute("aria-pressed", String(showsSpaces()));
}

function drawVerdicts(count) {
  const choice = (text, keys, does, shortcut) => {
    const made = element("button", "button", text);
    made.type = "button";
    made.setAttribute("aria-keyshortcuts", shortcut);
    keys.forEach((key) => made.append(element("kbd", "", key)));
    made.addEventListener("click", does);
    return made;
  };
  $("verdicts").className = count > 2 ? "verdicts ranking" : "verdicts";
  $("verdicts").replaceChildren(...(count > 2 ? [
    choice("Hand in this order", ["Enter"], submitRanking, "Enter"),
    choice("All the same", ["t"], () => judge("tie"), "t"),
    choice("All bad", ["b"], () => judge("both_bad"), "b"),
  ] : [
    choice("A is better", ["1", "←"], () => judge("a"), "1 ArrowLeft"),
    choice("B is better", ["2", "→"], () => judge("b"), "2 ArrowRight"),
    choice("Tie", ["3"], () => judge("tie"), "3 t"),
    choice("Both bad", ["4"], () => judge("both_bad"), "4 b"),
  ]));
}

// ---- rankings -----------------------------------------------------------------------------------------------------------------------

function rankNext(place) {
  ranking = ranking.map((group) => group.filter((other) => other !== place)).filter((group) => group.length);
  if (tieNext && ranking.length) ranking[ranking.length - 1].push(place);
  else ranking.push([place]);
  tieNext = false;
  drawRanking();
}

function dropped(place, target) {
  // What was not ranked keeps the order in which it stands.
  const order = [...document.querySelectorAll(".candidate")].map((each) => Number(each.dataset.place));
  const moved = order.filter((other) => other !== place);
  const at = order.indexOf(Number(target.dataset.place));
  moved.splice(at, 0, place);
  moved.forEach((other) => $("candidates").append(document.querySelector(`.candidate[data-place="${other}"]`)));
  ranking = moved.map((other) => [other]);
  drawRanking();
}

function drawRanking() {
  document.querySelectorAll(".candidate").forEach((each) => {
    const rank = ranking.findIndex((group) => group.includes(Number(each.dataset.place)));
    each.classList.toggle("ranked", rank >= 0);
    each.querySelector(".rank").textContent = rank < 0 ? "" : `rank ${rank + 1}`;
  });
  $("spoken").textContent = `Order: ${ranking.map((group) => group.map((place) => place + 1).join(" as good as ")).join(", then ")}`;
}

function submitRanking() {
  const count = queue[0].candidates.length;
  const ranks = Array(count).fill(-1);
  ranking.forEach((group, rank) => group.forEach((place) => { ranks[place] = rank; }));
  const left = ranks.filter((rank) => rank < 0).length;
  // One that is left over comes last.
  if (left > 1) { say(`${left} of ${count} have no place yet: press their digits, the best first.`); return; }
  say("");
  judge("ranking", ranks.map((rank) => (rank < 0 ? ranking.length : rank)));
}

// ---- words --------------------------------------------------------------------------------------------------------------------------

function say(line) { $("notice").textContent = line; }

function speak(verdict, ranks) {
  const words = { a: "A is better", b: "B is better", tie: "Tie", both_bad: "Both bad", skip: "Skipped", ranking: "Order handed in" };
  $("spoken").textContent = `${words[verdict]}. Next item.`;
}

function showSaved() {
  const waiting = outbox.length;
  $("saved").classList.toggle("waiting", offline);
  $("saved").textContent = offline
    ? `No connection. ${waiting ? `${waiting} kept here, to be sent` : "Trying again"}…`
    : waiting ? "Saving…" : counts.own ? "All saved" : "";
}

function showCounts() {
  const recent = times.filter((time) => time > performance.now() - RATE_WINDOW_MS);
  const minutes = recent.length > 1 ? (performance.now() - recent[0]) / 60000 : 0;
  const rate = minutes > 0.05 ? ` · ${(recent.length / minutes).toFixed(1)} a minute` : "";
  $("counts").textContent = `You: ${counts.own}${rate} · all: ${counts.done} of ${counts.items_in_all}`;
  $("progress").max = Math.max(counts.items_in_all, 1);
  $("progress").value = counts.done;
}

// ---- keys ---------------------------------------------------------------------------------------------------------------------------

function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || $("guidelines").open || !rater) return;
  if (event.target.matches("textarea, input:not([type=radio]), select")) return;
  if (event.key === "Enter" && event.target.closest("button, summary, a")) return;
  const item = queue[0];
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const anywhere = { u: undo, g: openGuidelines, w: switchSpaces };
  const pair = {
    1: () => judge("a"), ArrowLeft: () => judge("a"), 2: () => judge("b"), ArrowRight: () => judge("b"), 3: () => judge("tie"),
    t: () => judge("tie"), 4: () => judge("both_bad"), b: () => judge("both_bad"), s: () => judge("skip"), " ": toggleClips,
  };
  const several = {
    Enter: submitRanking, "=": () => { tieNext = true; }, Backspace: () => { ranking.at(-1)?.pop(); ranking = ranking.filter((group) => group.length); drawRanking(); },
    t: () => judge("tie"), b: () => judge("both_bad"), s: () => judge("skip"), " ": toggleClips,
  };
  let does = anywhere[key];
  if (!does && item && item === drawn) {
    if (event.target.matches("input[type=radio]") && key.startsWith("Arrow")) return;
    if (key === " " && event.target.closest("button, summary, input, video")) return;
    const isDigit = /^[1-9]$/.test(key);
    if (item.candidates.length <= 2) does = pair[key];
    else does = isDigit && Number(key) <= item.candidates.length ? () => rankNext(Number(key) - 1) : several[key];
  }
  if (!does) return;
  event.preventDefault();
  does();
}

function toggleClips() {
  const clips = [...document.querySelectorAll("video")];
  const stop = clips.some((clip) => !clip.paused);
  clips.forEach((clip) => (stop ? clip.pause() : clip.play()));
}

function openGuidelines() { $("guidelines").showModal(); }

// ---- beginning ----------------------------------------------------------------------------------------------------------------------

async function begin(name) {
  rater = name.trim().replace(/\s+/g, " ");
  sessionStorage.setItem("thorndike-rater", rater);
  $("sign-in").hidden = true;
  $("who").textContent = rater;
  restoreOutbox();
  $("whitespace").setAttribute("aria-pressed", String(showsSpaces()));
  await send();
  await more();
  const seen = `thorndike-guidelines:${location.host}:${rater}`;
  if (about.guidelines && !sessionStorage.getItem(seen)) { sessionStorage.setItem(seen, "yes"); openGuidelines(); }
}

document.addEventListener("keydown", pressed);
$("sign-in").addEventListener("submit", (event) => { event.preventDefault(); if ($("name").value.trim()) begin($("name").value); });
$("guidelines-button").addEventListener("click", openGuidelines);
$("skip").addEventListener("click", () => judge("skip"));
$("undo").addEventListener("click", undo);
$("undo-last").addEventListener("click", undo);
$("again").addEventListener("click", () => { exhausted = false; more(); });
$("whitespace").addEventListener("click", switchSpaces);
window.addEventListener("online", send);

about = await (await fetch("/label/about")).json();
$("project").textContent = about.project;
$("guidelines-text").textContent = about.guidelines || "There are none for this project: say what you find better.";
const named = new URLSearchParams(location.search).get("rater") || sessionStorage.getItem("thorndike-rater");
if (named) begin(named);
else { $("sign-in").hidden = false; $("name").focus(); }
