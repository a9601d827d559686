/* The interactive parts of the book, in plain JavaScript: nothing is fetched, so that they work from a disk.

   Two kinds of element come to life: .design-explorer, whose data (window.inflateExplorer) a script of the run sets, and
   .forward-slider, which carries its images. Controls are native form elements: the keyboard works by itself. */
"use strict";

(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const STEP_TIME = 180; // milliseconds that a load step is shown
  const NAMES = { height: "Height", width: "Width", area: "Hull area", box: "Height and width" };
  const SYMBOLS = { height: ["h"], width: ["w"], area: ["A"], box: ["h", "w"] };

  /* An element with attributes and children; text becomes text, never markup. */
  function make(name, attributes = {}, ...children) {
    const svg = ["svg", "path", "line", "rect", "circle", "title"].includes(name);
    const element = svg ? document.createElementNS(SVG, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.append(...children);
    return element;
  }

  function bytes(base64) {
    return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  }

  function slider(label, last) {
    const input = make("input", { type: "range", min: 0, max: last, step: 1, value: 0 });
    const value = make("span", { class: "slider-value", "aria-hidden": "true" }); // screen readers hear it from the slider
    const row = make("div", { class: "slider-row" }, make("label", {}, make("span", {}, label), input), value);
    const say = (text) => { value.textContent = text; input.setAttribute("aria-valuetext", text); };
    return { input, row, say };
  }

  const three = (numbers) => numbers.map((value) => value.toFixed(3)).join(", ");

  /* ---- the design explorer ---- */

  function explorer(root, data) {
    const points = new DataView(bytes(data.points).buffer);
    const last = data.states - 1;
    const kinds = Object.keys(data.descriptors);
    const quiet = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    let kind = kinds[0], chosen = 0, step = last, timer = null, shown = [], frame = null;

    const radios = kinds.map((name) => make("input", { type: "radio", name: "explorer-descriptor", value: name }));
    const choice = make("fieldset", { class: "explorer-choice" }, make("legend", {}, "Ask for"),
      ...kinds.map((name, i) => make("label", {}, radios[i], NAMES[name])));
    const target = make("div", { class: "explorer-target" });
    const load = slider("Load step", last);
    const play = make("button", { type: "button" }, "Inflate");
    const motion = make("div", { class: "explorer-motion" }, load.row, play);
    const status = make("p", { class: "explorer-status", role: "status", "aria-live": "polite" });
    const gallery = make("div", { class: "explorer-gallery" });
    root.append(choice, target, motion, status, gallery);

    /* Coordinates of one structure at one state: loops of [x, y]. */
    function loops(structure, state) {
      const lengths = [...structure.outer, ...structure.cavity];
      const size = lengths.reduce((sum, n) => sum + n, 0);
      let at = structure.at + 2 * size * state;
      return lengths.map((n) => Array.from({ length: n }, () => {
        const point = [points.getInt16(2 * at, true) / data.scale, points.getInt16(2 * at + 2, true) / data.scale];
        at += 2;
        return point;
      }));
    }

    const path = (polygons) => polygons.map((loop) => "M" + loop.map(([x, y]) => `${x} ${-y}`).join("L") + "Z").join("");

    function extent(structure, state) {
      const all = loops(structure, state).flat(), x = all.map((p) => p[0]), y = all.map((p) => p[1]);
      return { left: Math.min(...x), right: Math.max(...x), bottom: Math.min(...y), top: Math.max(...y) };
    }

    /* One scale for all targets of a descriptor, so that a larger target looks larger. */
    function commonFrame(name) {
      const margin = 0.1, frame = { width: 0, top: 0, bottom: 0 };
      for (const entry of data.descriptors[name]) {
        for (const structure of entry.structures) {
          for (const box of [extent(structure, 0), extent(structure, last)]) {
            frame.width = Math.max(frame.width, box.right - box.left + 2 * margin);
            frame.top = Math.max(frame.top, box.top + margin);
            frame.bottom = Math.min(frame.bottom, box.bottom - margin / 2);
          }
        }
      }
      return frame;
    }

    /* What was asked for, as lines around the inflated shape; an area has no place in the picture. */
    function wanted(box, values) {
      const middle = (box.left + box.right) / 2;
      const line = (x1, y1, x2, y2) => make("line", { x1, y1: -y1, x2, y2: -y2, class: "explorer-wanted" });
      if (kind === "height") {
        const y = box.bottom + values[0];
        return [line(box.left - 0.06, y, box.right + 0.06, y)];
      }
      if (kind === "width") {
        return [-0.5, 0.5].map((side) => line(middle + side * values[0], box.bottom, middle + side * values[0], box.top));
      }
      if (kind === "box") {
        const [h, w] = values;
        return [make("rect", { x: middle - w / 2, y: -(box.bottom + h), width: w, height: h, class: "explorer-wanted" })];
      }
      return [];
    }

    function draw() {
      for (const { structure, wall, air } of shown) {
        const polygons = loops(structure, step);
        wall.setAttribute("d", path(polygons));
        air.setAttribute("d", path(polygons.slice(structure.outer.length)));
      }
      load.input.value = step;
      load.say(step === 0 ? "at rest" : `${step} of ${last}`);
    }

    function select(number) {
      chosen = number;
      const entry = data.descriptors[kind][number], symbols = SYMBOLS[kind];
      shown = entry.structures.map((structure, i) => {
        const box = extent(structure, last);
        const left = (box.left + box.right - frame.width) / 2, right = left + frame.width;
        const reached = `${symbols.join(", ")} = ${three(structure.achieved)}`;
        const error = `${(100 * structure.error).toFixed(1)} % off`;
        const wall = make("path", { class: "explorer-wall", "fill-rule": "evenodd" });
        const air = make("path", { class: "explorer-air" });
        const picture = make("svg", { viewBox: `${left} ${-frame.top} ${frame.width} ${frame.top - frame.bottom}`, role: "img" },
          make("title", {}, `Structure ${i + 1}: ${reached}, ${error}`), air, wall,
          make("line", { x1: left, y1: 0, x2: right, y2: 0, class: "explorer-ground" }), ...wanted(box, entry.target));
        const caption = make("figcaption", {}, reached, make("br"), error);
        return { structure, wall, air, figure: make("figure", { "data-at": structure.at }, picture, caption) };
      });
      gallery.replaceChildren(...shown.map((one) => one.figure));
      status.textContent = `Target ${symbols.join(", ")} = ${three(entry.target)}. ` +
        `${entry.valid} of ${data.about.drawn} drawings were valid, ${entry.buildable} could be built; ` +
        (shown.length ? `${shown.length} of them are shown.` : "there is nothing to show.");
      draw();
    }

    function stop() {
      clearInterval(timer);
      timer = null;
      play.textContent = "Inflate";
    }

    function start() {
      step = 0;
      draw();
      play.textContent = "Stop";
      clearInterval(timer);
      timer = setInterval(() => {
        step += 1;
        draw();
        if (step === last) stop();
      }, STEP_TIME);
    }

    function pick(number) {
      stop();
      step = last;
      select(number);
      if (!quiet) start();
    }

    /* One slider for a number; for a box two sliders, and the plane with all targets, to be dragged in. */
    function targets() {
      const entries = data.descriptors[kind];
      if (kind !== "box") {
        const one = slider(NAMES[kind], entries.length - 1);
        const show = () => one.say(three(entries[one.input.value].target));
        one.input.addEventListener("input", () => { show(); pick(Number(one.input.value)); });
        one.input.value = chosen = Math.floor(entries.length / 2);
        show();
        target.replaceChildren(one.row);
        return;
      }
      const n = Math.round(Math.sqrt(entries.length));
      const rows = slider("Height", n - 1), columns = slider("Width", n - 1);
      const h = entries.map((e) => e.target[0]), w = entries.map((e) => e.target[1]);
      const low = [Math.min(...w), Math.min(...h)], high = [Math.max(...w), Math.max(...h)];
      const place = (i) => [8 + 84 * (w[i] - low[0]) / (high[0] - low[0] || 1), 92 - 84 * (h[i] - low[1]) / (high[1] - low[1] || 1)];
      const dots = entries.map((_, i) => make("circle", { cx: place(i)[0], cy: place(i)[1], r: 1.6, class: "explorer-dot" }));
      const hand = make("circle", { r: 4, class: "explorer-hand" });
      const plane = make("svg", { viewBox: "0 0 100 100", class: "explorer-plane", "aria-hidden": "true" }, ...dots, hand);
      function move(i, follow = true) {
        rows.input.value = Math.floor(i / n);
        columns.input.value = i % n;
        rows.say(h[i].toFixed(3));
        columns.say(w[i].toFixed(3));
        hand.setAttribute("cx", place(i)[0]);
        hand.setAttribute("cy", place(i)[1]);
        if (follow && i !== chosen) pick(i);
      }
      const fromSliders = () => move(n * Number(rows.input.value) + Number(columns.input.value));
      rows.input.addEventListener("input", fromSliders);
      columns.input.addEventListener("input", fromSliders);
      function drag(event) {
        const frame = plane.getBoundingClientRect();
        const x = 100 * (event.clientX - frame.left) / frame.width, y = 100 * (event.clientY - frame.top) / frame.height;
        const apart = entries.map((_, i) => Math.hypot(place(i)[0] - x, place(i)[1] - y));
        move(apart.indexOf(Math.min(...apart)));
      }
      plane.addEventListener("pointerdown", (event) => { plane.setPointerCapture(event.pointerId); drag(event); });
      plane.addEventListener("pointermove", (event) => { if (plane.hasPointerCapture(event.pointerId)) drag(event); });
      chosen = n * Math.floor(n / 2) + Math.floor(n / 2);
      move(chosen, false);
      const axes = make("div", { class: "explorer-axes" }, plane, make("span", {}, "width →"), make("span", {}, "height ↑"));
      target.replaceChildren(make("div", {}, rows.row, columns.row), axes);
    }

    function change(name) {
      stop();
      kind = name;
      frame = commonFrame(name);
      radios[kinds.indexOf(name)].checked = true;
      step = last;
      targets();
      select(chosen);
    }

    radios.forEach((radio) => radio.addEventListener("change", () => change(radio.value)));
    load.input.addEventListener("input", () => { stop(); step = Number(load.input.value); draw(); });
    play.addEventListener("click", () => (timer ? stop() : start()));
    change(kinds[0]);
  }

  /* ---- the forward process ---- */

  function forward(root) {
    const { pixels, size, steps, alphaBars } = root.dataset;
    const [rows, columns] = size.split(" ").map(Number);
    const times = steps.split(" ").map(Number), left = alphaBars.split(" ").map(Number), grey = bytes(pixels);
    const canvas = make("canvas", { width: columns, height: rows, role: "img" });
    const step = slider("Noising steps", times.length - 1);
    const words = make("p", { role: "status", "aria-live": "polite" });
    const context = canvas.getContext("2d");
    function draw() {
      const i = Number(step.input.value), image = context.createImageData(columns, rows);
      for (let k = 0; k < rows * columns; k += 1) {
        image.data.fill(grey[i * rows * columns + k], 4 * k, 4 * k + 3);
        image.data[4 * k + 3] = 255;
      }
      context.putImageData(image, 0, 0);
      step.say(`t = ${times[i]}`);
      const signal = Math.sqrt(left[i]).toFixed(3), noise = Math.sqrt(1 - left[i]).toFixed(3);
      words.textContent = `${signal} times the image, ${noise} times the noise`;
      canvas.setAttribute("aria-label", `The image after ${times[i]} noising steps: ${words.textContent}`);
    }
    step.input.addEventListener("input", draw);
    root.append(canvas, step.row, words);
    draw();
  }

  document.addEventListener("DOMContentLoaded", () => {
    document.querySelectorAll(".forward-slider").forEach(forward);
    document.querySelectorAll(".design-explorer").forEach(window.inflateMountExplorer);
  });
  /* The laboratory shows it, too, where a browser cannot do what it needs. */
  window.inflateMountExplorer = (root) => {
    if (window.inflateExplorer) explorer(root, window.inflateExplorer);
    else root.append(make("p", {}, "The data of this page are missing: explorer_data.js was not found."));
  };
})();
