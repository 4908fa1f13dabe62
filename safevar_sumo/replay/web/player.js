"use strict";
for (const player of document.querySelectorAll(".player")) {
  const data = JSON.parse(player.querySelector("script").textContent);
  const find = (name) => player.querySelector(name);
  const stage = find(".stage"), slider = find(".when"), button = find(".play"), pace = find(".pace"), last = data.length - 1;
  const at = (values, i) => (Array.isArray(values) ? values[i] : values);
  let now = data.key, begun = 0, from = 0, frame = 0;

  function show(i) {
    now = Math.max(0, Math.min(last, i));
    const view = data.view;
    stage.setAttribute("viewBox", `${at(view.left, now)} ${view.top} ${view.width} ${view.height}`);
    stage.querySelectorAll("[data-body]").forEach((part) => {
      const body = data.bodies[part.dataset.body], x = at(body.x, now);
      part.style.display = x === null ? "none" : "";
      if (x !== null) part.setAttribute("transform", `translate(${x} ${at(body.y, now)}) rotate(${at(body.heading, now)})`);
      if (body.drive !== null) part.classList.toggle("brakes", data.drives[body.drive].brakes[Math.min(now, data.drives[body.drive].end)] === 1);
    });
    find(".time").textContent = `${(now * data.step).toFixed(2)} s`;
    data.drives.forEach((drive, k) => {
      const row = player.querySelectorAll(".reading")[k], i = Math.min(now, drive.end), gap = at(drive.gap, i);
      row.querySelector(".speed").textContent = `${drive.speed[i].toFixed(1)} m/s`;
      row.querySelector(".gap").textContent = gap === null ? "" : `gap ${Math.max(gap, 0).toFixed(1)} m`;
      row.querySelector(".state").textContent = now >= drive.nearest ? drive.verdict : drive.brakes[i] ? "brakes" : "";
    });
    slider.value = now;
    slider.setAttribute("aria-valuetext", `${(now * data.step).toFixed(2)} seconds`);
  }
  function step(clock) {
    if (!begun) begun = clock;
    const i = from + Math.floor((clock - begun) / 1000 * Number(pace.value) / data.step);
    show(i);
    if (i >= last) stop(); else frame = requestAnimationFrame(step);
  }
  function stop() {
    cancelAnimationFrame(frame);
    frame = 0;
    button.textContent = "Play";
  }
  function play() {
    begun = 0;
    from = now >= last ? 0 : now;
    button.textContent = "Pause";
    frame = requestAnimationFrame(step);
  }
  button.addEventListener("click", () => (frame ? stop() : play()));
  pace.addEventListener("change", () => { if (frame) { stop(); play(); } });
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  player.querySelectorAll("[data-sample]").forEach((one) =>
    one.addEventListener("click", () => { stop(); show(Number(one.dataset.sample)); }));
  player.classList.remove("still");
  show(now);
}
