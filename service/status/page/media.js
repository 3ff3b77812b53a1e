// Recordings of a run, the newest first, and its pictures, from RunFiles.

import { address } from "./api.js";
import { el, note } from "./dom.js";
import { bytes } from "./format.js";
import { age } from "./widgets.js";

/** A video keeps playing until there is a newer one, or another is chosen. */
export class Media {
  constructor(runId) {
    this.runId = runId;
    this.shown = null;
    this.root = el("div", { class: "media" });
  }

  update({ files }) {
    const key = JSON.stringify(files);
    if (key === this.shown) return;
    this.shown = key;
    const isVideo = (file) => file.media_type.startsWith("video/");
    const videos = files.filter(isVideo).sort((a, b) => Date.parse(b.modified) - Date.parse(a.modified));
    const pictures = files.filter((file) => !isVideo(file));
    const film = videos.length ? this.film(videos) : note("No video yet: a run makes one at its end.");
    this.root.replaceChildren(film, el("ul", { class: "pictures" }, ...pictures.map((file) => this.picture(file))));
  }

  /** The newest video, and those that it has replaced. */
  film(videos) {
    const place = el("div", {}, this.video(videos[0]));
    if (videos.length === 1) return place;
    const buttons = videos.map((file) => {
      const button = el("button", { type: "button" }, `${file.title}, `, age(file.modified));
      button.addEventListener("click", () => place.replaceChildren(this.video(file)));
      return el("li", {}, button);
    });
    return el("div", {}, place, el("ol", { class: "history", "aria-label": "Recordings" }, ...buttons));
  }

  video(file) {
    const player = el("video", { controls: true, preload: "metadata", muted: true, loop: true, playsinline: true, src: `${this.url(file)}#t=0.1`, "aria-label": file.title });
    const words = [`${file.title}, ${bytes(file.num_bytes)}, `, age(file.modified), ". "];
    return el("figure", { class: "recording" }, player, el("figcaption", {}, ...words, el("a", { href: this.url(file), download: file.name }, "Download")));
  }

  picture(file) {
    const image = el("img", { src: this.url(file), alt: "", loading: "lazy", decoding: "async" });
    return el("li", {}, el("a", { href: this.url(file) }, image, file.title), ` ${bytes(file.num_bytes)}`);
  }

  /** The URL with the file's time, so that a browser does not show an older file from its cache. */
  url(file) {
    return `${address("v1", "runs", this.runId, "files", file.name)}?modified=${encodeURIComponent(file.modified)}`;
  }
}
