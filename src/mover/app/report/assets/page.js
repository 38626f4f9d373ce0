// Before and after: drag anywhere on the picture.
"use strict";
(() => {
  for (const figure of document.querySelectorAll(".compare")) {
    const range = figure.querySelector("input");
    const cut = (share) => {
      const percent = Math.min(100, Math.max(0, 100 * share));
      range.value = percent;
      figure.style.setProperty("--cut", `${percent}%`);
    };
    const follow = (e) => {
      const box = figure.getBoundingClientRect();
      cut((e.clientX - box.left) / box.width);
    };
    figure.addEventListener("pointerdown", (e) => { figure.setPointerCapture(e.pointerId); follow(e); });
    figure.addEventListener("pointermove", (e) => { if (figure.hasPointerCapture(e.pointerId)) follow(e); });
    range.addEventListener("input", () => cut(range.value / 100));
  }
})();
