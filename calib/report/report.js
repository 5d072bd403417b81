"use strict";
// Shows the values of all series at one time (pointer or keys), and zooms along x. It reads the values from the paths.
(() => {
  const numbers = (text) => text.split(" ").map(Number);
  const clip = (value, low, high) => Math.min(Math.max(value, low), high);
  const add = (parent, tag, style, text) => {
    const made = document.createElement(tag);
    made.className = style;
    if (text !== undefined) made.textContent = text;
    return parent.appendChild(made);
  };

  function points(path) {
    // "M12 34L56 78h0M...": pairs of whole numbers; bars are "M x zero V y".
    const found = [];
    for (const [, kind, x, y] of path.getAttribute("d").matchAll(/([MLV])(-?\d+)(?: (-?\d+))?/g)) {
      if (kind === "V") found[found.length - 1][1] = Number(x);
      else found.push([Number(x), Number(y)]);
    }
    return found;
  }

  function nearest(series, x) {
    let low = 0, high = series.length - 1;
    if (high < 0) return null;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (series[middle][0] < x) low = middle; else high = middle;
    }
    return x - series[low][0] < series[high][0] - x ? series[low] : series[high];
  }

  function ticks(low, high) {
    const least = (high - low) / 6, power = 10 ** Math.floor(Math.log10(least));
    const step = [1, 2, 5, 10].map((s) => s * power).find((s) => s >= least * 0.999999);
    const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
      found.push([k * step, (k * step).toFixed(decimals).replace("-", "\u2212")]);
    }
    return found;
  }

  class Chart {
    constructor(figure) {
      this.plot = figure.querySelector(".plot");
      this.svg = this.plot.querySelector("svg");
      [, , this.width, this.height] = numbers(this.svg.getAttribute("viewBox"));
      this.x = numbers(figure.dataset.x);
      this.y = numbers(figure.dataset.y);
      this.log = "log" in figure.dataset;
      this.linked = "linked" in figure.dataset;
      this.title = figure.querySelector("figcaption").textContent;
      this.xTitle = figure.querySelector(".xtitle").textContent;
      this.view = [0, this.width];
      this.at = null;
    }

    series() {
      this.read ??= [...this.svg.querySelectorAll("[data-name]")].map((path) => ({
        name: path.dataset.name, style: path.classList[1], points: points(path) }));
      return this.read;
    }

    xOf(unit) { return this.x[0] + (this.x[1] - this.x[0]) * unit / this.width; }

    yOf(unit) {
      const [low, high] = this.log ? this.y.map(Math.log10) : this.y;
      const value = high - (high - low) * unit / this.height;
      return this.log ? 10 ** value : value;
    }

    words(value, step) {
      const digits = clip(Math.ceil(Math.log10(Math.abs(value) / step + 1e-300)), 1, 5);
      return value.toPrecision(digits).replace("-", "\u2212");
    }

    point(unit, withValues) {
      this.clear();
      this.at = clip(unit, ...this.view);
      const share = (this.at - this.view[0]) / (this.view[1] - this.view[0]);
      add(this.plot, "div", "cross").style.left = `${100 * share}%`;
      if (!withValues) return;
      const tip = add(this.plot, "div", "tip");
      tip.setAttribute("role", "status");
      const name = /^(.*?)(?: \[(.*)\])?$/.exec(this.xTitle), unitOf = /\[(.*)\]$/.exec(this.title);
      add(tip, "b", "", `${name[1]} ${this.words(this.xOf(this.at), (this.x[1] - this.x[0]) / 1000)} ${name[2] ?? ""}`);
      for (const { name: called, style, points: list } of this.series()) {
        const near = nearest(list, this.at);
        if (!near) continue;
        const row = add(tip, "div", "");
        add(row, "span", `key ${style}`);
        const value = this.yOf(near[1]), step = this.log ? value / 1000 : (this.y[1] - this.y[0]) / this.height;
        row.append(`${called} ${this.words(value, step)} ${unitOf ? unitOf[1] : ""}`);
      }
      if (share > 0.5) tip.style.right = `calc(${100 * (1 - share)}% + .5rem)`;
      else tip.style.left = `calc(${100 * share}% + .5rem)`;
    }

    clear() { this.plot.querySelectorAll(".cross, .tip, .chosen").forEach((one) => one.remove()); }

    zoom(low, high) {
      const least = this.width / 500;
      if (high - low < least) [low, high] = [(low + high - least) / 2, (low + high + least) / 2];
      this.view = [clip(low, 0, this.width - least), clip(high, least, this.width)];
      this.svg.setAttribute("viewBox", `${this.view[0]} 0 ${this.view[1] - this.view[0]} ${this.height}`);
      this.plot.querySelectorAll(".xt").forEach((one) => one.remove());
      const [first, last] = this.view.map((unit) => this.xOf(unit));
      for (const [value, text] of ticks(first, last)) {
        add(this.plot, "i", "xt", text).style.left = `${100 * (value - first) / (last - first)}%`;
      }
    }
  }

  document.documentElement.classList.add("js");
  for (const group of document.querySelectorAll(".panels")) {
    const charts = [...group.querySelectorAll(".panel")].map((figure) => new Chart(figure));
    for (const chart of charts) {
      const plot = chart.plot;
      const others = () => (chart.linked ? charts.filter((one) => one.linked && one !== chart) : []);
      const all = () => [chart, ...others()];
      const unitAt = (event) => {
        const box = plot.getBoundingClientRect();
        return chart.view[0] + (chart.view[1] - chart.view[0]) * clip((event.clientX - box.left) / box.width, 0, 1);
      };
      const show = (unit) => { chart.point(unit, true); others().forEach((one) => one.point(unit, false)); };
      const clear = () => all().forEach((one) => one.clear());
      const zoom = (low, high) => { clear(); all().forEach((one) => one.zoom(low, high)); };
      let from = null;

      plot.addEventListener("pointerdown", (event) => {
        if (event.button !== 0) return;
        from = unitAt(event);
        show(from);
        plot.setPointerCapture(event.pointerId);
      });
      plot.addEventListener("pointermove", (event) => {
        const to = unitAt(event);
        show(to);
        if (from === null) return;
        const share = (unit) => 100 * (unit - chart.view[0]) / (chart.view[1] - chart.view[0]);
        const chosen = add(plot, "div", "chosen");
        chosen.style.left = `${share(Math.min(from, to))}%`;
        chosen.style.width = `${Math.abs(share(to) - share(from))}%`;
      });
      plot.addEventListener("pointerup", (event) => {
        const to = unitAt(event), begun = from;
        from = null;
        if (begun !== null && Math.abs(to - begun) > 0.02 * (chart.view[1] - chart.view[0])) {
          zoom(Math.min(begun, to), Math.max(begun, to));
        }
      });
      plot.addEventListener("pointercancel", () => { from = null; clear(); });
      plot.addEventListener("pointerleave", () => { if (from === null) clear(); });
      plot.addEventListener("blur", clear);
      plot.addEventListener("dblclick", () => zoom(0, chart.width));
      plot.addEventListener("keydown", (event) => {
        const [low, high] = chart.view, span = high - low, at = chart.at ?? (low + high) / 2;
        const step = (event.shiftKey ? 0.1 : 0.01) * span;
        const closer = (share) => zoom(at - (at - low) * share, at + (high - at) * share);
        const actions = {
          ArrowLeft: () => show(at - step), ArrowRight: () => show(at + step),
          "+": () => closer(0.5), "=": () => closer(0.5), "-": () => closer(2),
          Escape: () => zoom(0, chart.width), 0: () => zoom(0, chart.width),
        };
        if (!(event.key in actions) || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        actions[event.key]();
      });
    }
  }
})();
