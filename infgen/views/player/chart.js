// The strip below: how many agents there are over time, who comes and who goes, in every
// showing. It is drawn once; only the playhead moves.

const [LEFT_PX, RIGHT_PX, TOP_PX] = [40, 14, 26]; // The slider lies on the same axis.
const [ROW_PX, TICKS_PX, GAP_PX] = [17, 17, 7];
const BIN_S = 0.5; // Agents enter and leave by half seconds.
const DASHES = [[], [7, 3], [2, 3], [9, 3, 2, 3], [12, 4]];

export class Chart {
  constructor(element, film, clock) {
    this.element = element;
    this.canvas = element.querySelector("canvas");
    this.playhead = element.querySelector(".playhead");
    this.film = film;
    this.clock = clock;
  }

  x(time) {
    const { start, end } = this.clock;
    return LEFT_PX + ((time - start) / (end - start)) * (this.width - LEFT_PX - RIGHT_PX);
  }

  timeAt(x) {
    const { start, end } = this.clock;
    return start + ((x - LEFT_PX) / (this.width - LEFT_PX - RIGHT_PX)) * (end - start);
  }

  /** Draw all of it anew, for the panes that are shown. */
  draw(panes, colours) {
    const shown = panes.filter((pane) => pane.shown);
    this.element.style.setProperty("--rows", shown.length);
    const density = Math.min(2, devicePixelRatio || 1);
    [this.width, this.height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    this.canvas.width = Math.round(this.width * density);
    this.canvas.height = Math.round(this.height * density);
    this.context = this.canvas.getContext("2d");
    this.context.setTransform(density, 0, 0, density, 0, 0);
    this.context.font = "11px system-ui, sans-serif";
    this.bottom = this.height - TICKS_PX - ROW_PX * shown.length - GAP_PX;
    this.drawHistory(colours);
    this.drawAxes(shown, colours);
    shown.forEach((pane) => this.drawCount(pane, colours));
    this.drawWords(colours);
    const most = mostInBin(shown, this.film);
    shown.forEach((pane, at) => {
      this.drawFlow(pane, this.bottom + GAP_PX + ROW_PX * (at + 0.5), most, colours);
    });
  }

  drawHistory(colours) {
    const bottom = this.height - TICKS_PX;
    this.context.fillStyle = colours.faint;
    this.context.globalAlpha = 0.45;
    const [left, right] = [this.x(this.clock.start), this.x(0)];
    this.context.fillRect(left, TOP_PX, right - left, bottom - TOP_PX);
    this.context.globalAlpha = 1;
  }

  drawAxes(shown, colours) {
    const { context } = this;
    this.most = Math.max(4, ...shown.map((pane) => Math.max(...pane.showing.present)));
    const step = niceStep(this.most, 3);
    context.strokeStyle = colours.faint;
    context.fillStyle = colours.quiet;
    context.lineWidth = 1;
    context.textAlign = "right";
    for (let count = 0; count <= this.most; count += step) {
      const y = Math.round(this.y(count)) + 0.5;
      this.line(LEFT_PX, y, this.width - RIGHT_PX, y);
      context.fillText(count, LEFT_PX - 6, y + 4);
    }
    const seconds = niceStep(this.clock.end - this.clock.start, Math.max(3, this.width / 110));
    context.textAlign = "center";
    for (let time = 0; time <= this.clock.end + 1e-6; time += seconds) {
      context.fillText(time ? time : "now", this.x(time), this.height - 4);
      const x = Math.round(this.x(time)) + 0.5;
      this.line(x, this.height - TICKS_PX, x, this.height - TICKS_PX + 3);
    }
  }

  y(count) {
    return this.bottom - (count / this.most) * (this.bottom - TOP_PX);
  }

  line(fromX, fromY, toX, toY) {
    this.context.beginPath();
    this.context.moveTo(fromX, fromY);
    this.context.lineTo(toX, toY);
    this.context.stroke();
  }

  drawWords(colours) {
    const { context } = this;
    context.textAlign = "right";
    context.lineWidth = 3;
    context.strokeStyle = colours.panel;
    context.fillStyle = colours.quiet;
    const words = [["agents", TOP_PX + 9], ["came \u25b4 went \u25be", this.bottom + 5]];
    for (const [text, y] of words) {
      context.strokeText(text, this.width - RIGHT_PX - 2, y);
      context.fillText(text, this.width - RIGHT_PX - 2, y);
    }
  }

  drawCount(pane, colours) {
    const { context } = this;
    const { present } = pane.showing;
    context.beginPath();
    for (let step = 0; step < present.length; step++) {
      context.lineTo(this.x((step - this.film.now) * this.film.stepS), this.y(present[step]));
    }
    context.strokeStyle = colours[pane.colour];
    context.lineWidth = pane.showing.name === "log" ? 2.4 : 1.6;
    context.setLineDash(DASHES[pane.dash]);
    context.stroke();
    context.setLineDash([]);
  }

  /** Entries upwards, exits downwards, second by second. */
  drawFlow(pane, middle, most, colours) {
    const { context } = this;
    context.fillStyle = colours.quiet;
    context.textAlign = "right";
    context.fillText(pane.short, LEFT_PX - 6, middle + 4);
    context.fillStyle = colours[pane.colour];
    context.globalAlpha = 0.3;
    context.fillRect(LEFT_PX, middle - 0.5, this.width - LEFT_PX - RIGHT_PX, 1);
    const half = ROW_PX / 2 - 1.5;
    const flow = [[pane.showing.entries, -1, 1], [pane.showing.exits, 1, 0.5]];
    for (const [values, side, alpha] of flow) {
      context.globalAlpha = alpha;
      binned(values, this.film).forEach((count, bin) => {
        const left = this.x(bin * BIN_S) + 0.5;
        const height = count && Math.max(1.5, (count / most) * half);
        const top = side < 0 ? middle - 0.5 - height : middle + 0.5;
        if (count) context.fillRect(left, top, this.x((bin + 1) * BIN_S) - left - 0.5, height);
      });
    }
    context.globalAlpha = 1;
  }

  /** Where the time is now. */
  movePlayhead(time) {
    this.playhead.style.transform = `translateX(${this.x(time).toFixed(1)}px)`;
  }
}

/** Sum values per step after now over whole seconds. */
function binned(values, film) {
  const steps = Math.round(BIN_S / film.stepS);
  const found = [];
  for (let step = film.now + 1; step < values.length; step++) {
    const bin = Math.floor((step - film.now - 1) / steps);
    found[bin] = (found[bin] ?? 0) + values[step];
  }
  return found;
}

function mostInBin(panes, film) {
  const all = panes.flatMap((pane) => [pane.showing.entries, pane.showing.exits]);
  return Math.max(1, ...all.flatMap((values) => binned(values, film)));
}

/** A step of 1, 2 or 5 times a power of ten that cuts a range into about so many parts. */
function niceStep(range, parts) {
  const power = 10 ** Math.floor(Math.log10(range / parts));
  return [1, 2, 5, 10].map((part) => part * power).find((step) => range / step <= parts);
}
