// A run's newest video, and its pictures.

import { address } from "./api.js";
import { el, note } from "./dom.js";
import { bytes } from "./format.js";
import { age } from "./times.js";

/** Of RunFiles; a film that is being watched is left alone until there is a newer one. */
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
    const video = videos.length ? this.video(videos[0]) : note("No video yet: a run films a few rounds at its end.");
    this.root.replaceChildren(video, el("ul", { class: "pictures" }, ...pictures.map((file) => this.picture(file))));
  }

  video(file) {
    const film = el("video", { controls: true, preload: "metadata", muted: true, loop: true, playsinline: true, src: `${this.url(file)}#t=0.1`, "aria-label": file.title });
    const words = [`${file.title}, ${bytes(file.num_bytes)}, `, age(file.modified), ". "];
    return el("figure", { class: "film" }, film, el("figcaption", {}, ...words, el("a", { href: this.url(file), download: file.name }, "Download")));
  }

  picture(file) {
    const image = el("img", { src: this.url(file), alt: "", loading: "lazy", decoding: "async" });
    return el("li", {}, el("a", { href: this.url(file) }, image, file.title), ` ${bytes(file.num_bytes)}`);
  }

  /** With its time, so that a browser does not show what it has of an older one. */
  url(file) {
    return `${address("v1", "runs", this.runId, "files", file.name)}?modified=${encodeURIComponent(file.modified)}`;
  }
}
