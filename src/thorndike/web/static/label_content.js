// What is compared, drawn: text with its spaces kept, conversations, films and pictures.

export const element = (tag, classes, text) => {
  const made = document.createElement(tag);
  if (classes) made.className = classes;
  if (text !== undefined) made.textContent = text;
  return made;
};
export const letter = (place) => String.fromCharCode(65 + place);

export function parts(content, place = 0) {
  const found = [];
  if (content.kind === "video") {
    const video = element("video");
    Object.assign(video, { src: content.media, loop: true, muted: true, playsInline: true, preload: "auto" });
    video.setAttribute("aria-label", `Clip ${letter(place)}`);
    // Who asked for less motion starts clips by the space bar or the controls.
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) video.controls = true;
    else video.autoplay = true;
    found.push(video);
  } else if (content.kind === "image") {
    const image = element("img");
    image.src = content.media;
    image.alt = `Clip ${letter(place)}`;
    found.push(image);
  } else if (content.kind === "unknown") found.push(element("p", "quiet", "This kind of file cannot be shown: skip it."));
  if (content.text !== undefined) found.push(marked(element("div", "content"), content.text));
  for (const message of content.messages ?? []) {
    const turn = element("div", "turn");
    turn.append(element("span", "role", message.role), marked(element("div", "content"), message.content));
    found.push(turn);
  }
  return found;
}

function marked(box, text) {
  box.dataset.text = text;
  if (!showsSpaces()) { box.textContent = text; return box; }
  box.replaceChildren(...text.split(/( |\t|\n)/).filter((part) => part !== "").flatMap((part) => {
    const sign = { " ": "·", "\t": "→\t", "\n": "↵\n" }[part];
    // Lines may break after a sign, as they did at the space.
    return sign ? [element("span", "mark", sign), document.createElement("wbr")] : [document.createTextNode(part)];
  }));
  return box;
}

export const showsSpaces = () => localStorage.getItem("thorndike-label-spaces") === "yes";

export function toggleSpaces() {
  localStorage.setItem("thorndike-label-spaces", showsSpaces() ? "no" : "yes");
  document.querySelectorAll(".content").forEach((box) => marked(box, box.dataset.text));
}
