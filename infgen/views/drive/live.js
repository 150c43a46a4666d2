// A showing that grows at one end and is forgotten at the other: the last seconds of a drive.
//
// It has the fields of a film's showing, so that the same pane draws it. A column is a step of
// 0.1 s; column 0 is step `offset` of the scene. Rows are used again once nobody sees them.

import { buildShape } from "./agents.js";

export const COLUMNS = 64;
const SPARE_ROWS = 192;
const FREE = -1;
const FORGOTTEN = -10; // Columns after the end of an agent's ghost.
const [EGO, INITIAL, INSERTED] = [0, 1, 2];
const STEPS = 5;

export class LiveShowing {
  constructor(history, now) {
    const rows = 2 * history.agents + SPARE_ROWS;
    const cells = () => new Float32Array(rows * COLUMNS);
    this.name = "drive";
    this.ego = history.ego;
    [this.agents, this.steps] = [rows, COLUMNS];
    this.offset = now - COLUMNS + 1;
    this.id = new Int32Array(rows).fill(FREE);
    [this.kind, this.role] = [new Int8Array(rows), new Int8Array(rows)];
    [this.length, this.width] = [new Float32Array(rows), new Float32Array(rows)];
    [this.first, this.last] = [new Int32Array(rows), new Int32Array(rows).fill(COLUMNS)];
    [this.x, this.y, this.heading] = [cells(), cells(), cells()];
    this.there = new Uint8Array(rows * COLUMNS);
    const columns = () => new Int32Array(COLUMNS);
    [this.present, this.entered, this.left] = [columns(), columns(), columns()];
    [this.shapes, this.rows] = [new Array(rows), new Map()];
    this.egoColumn = COLUMNS - 1;
    this.begin(history);
  }

  /** Step of the last column. */
  get newest() {
    return this.offset + COLUMNS - 1;
  }

  begin(history) {
    for (let row = 0; row < history.agents; row++) {
      const size = [history.length[row], history.width[row]];
      this.enter(row, history.id[row], history.kind[row], history.role[row], size);
      this.first[row] = history.first[row] - this.offset;
      for (let step = Math.max(0, this.offset); step < history.steps; step++) {
        const [from, to] = [row * history.steps + step, row * COLUMNS + step - this.offset];
        for (const axis of ["x", "y", "heading", "there"]) this[axis][to] = history[axis][from];
      }
    }
    for (let column = 0; column < COLUMNS; column++) this.count(column);
  }

  enter(row, id, kind, role, [length, width]) {
    [this.id[row], this.kind[row], this.role[row]] = [id, kind, role];
    [this.length[row], this.width[row]] = [length, width];
    this.last[row] = COLUMNS;
    this.shapes[row] = buildShape(kind, length, width);
    this.rows.set(id, row);
  }

  /** Take the next token step: five more columns. */
  take(frame) {
    this.shift();
    const here = new Set([this.ego]);
    let [entered, left] = [this.entered[COLUMNS - STEPS - 1], this.left[COLUMNS - STEPS - 1]];
    frame.id.forEach((id, at) => {
      const known = this.rows.has(id);
      const row = this.rows.get(id) ?? this.freeRow();
      if (row === undefined) return; // More agents than ever; they are not drawn.
      if (!known) {
        this.enter(row, id, frame.kind[at], frame.role[at], frame.size[at]);
        this.first[row] = COLUMNS - STEPS;
        if (frame.role[at] === INSERTED) entered++;
      }
      here.add(row);
      this.write(row, frame.path[at]);
      if (frame.removed[at]) [this.last[row], left] = [COLUMNS - 1, left + 1];
    });
    this.leaveOut(here);
    for (let column = COLUMNS - STEPS; column < COLUMNS; column++) {
      [this.entered[column], this.left[column]] = [entered, left];
      this.count(column);
    }
  }

  shift() {
    for (const values of [this.x, this.y, this.heading, this.there]) {
      values.copyWithin(0, STEPS); // Row after row: what comes in at a row's end is cleared.
    }
    for (let row = 0; row < this.agents; row++) {
      this.there.fill(0, (row + 1) * COLUMNS - STEPS, (row + 1) * COLUMNS);
      this.first[row] -= STEPS;
      if (this.last[row] === COLUMNS) continue;
      this.last[row] -= STEPS;
      if (this.last[row] < FORGOTTEN) this.free(row);
    }
    for (const values of [this.present, this.entered, this.left]) values.copyWithin(0, STEPS);
    this.offset += STEPS;
    this.egoColumn -= STEPS;
  }

  free(row) {
    this.rows.delete(this.id[row]);
    [this.id[row], this.last[row]] = [FREE, COLUMNS];
  }

  freeRow() {
    const row = this.id.indexOf(FREE);
    return row < 0 ? undefined : row;
  }

  /** Write poses at the last five columns; headings go on without jumps of whole turns. */
  write(row, path) {
    const end = (row + 1) * COLUMNS;
    for (let step = 0; step < STEPS; step++) {
      const cell = end - STEPS + step;
      const [x, y, heading] = path.slice(3 * step, 3 * step + 3);
      [this.x[cell], this.y[cell], this.there[cell]] = [x, y, 1];
      const before = this.there[cell - 1] ? this.heading[cell - 1] : heading;
      this.heading[cell] = before + turn(heading - before);
    }
  }

  /** Let go of those that a token step no longer names. */
  leaveOut(here) {
    for (let row = 0; row < this.agents; row++) {
      const gone = this.id[row] !== FREE && !here.has(row) && this.last[row] === COLUMNS;
      if (gone) this.last[row] = COLUMNS - STEPS - 1;
    }
  }

  count(column) {
    let present = 0;
    for (let row = 0; row < this.agents; row++) present += this.there[row * COLUMNS + column];
    const future = column > this.egoColumn ? 1 : 0; // The ego will be there too.
    this.present[column] = present + future;
  }

  /** Put the ego where it is at a time between two columns; it moves at some rate a column. */
  placeEgo(time, pose, rate) {
    const column = Math.min(Math.floor(time), COLUMNS - 1);
    const next = Math.min(column + 1, COLUMNS - 1);
    for (let at = Math.max(0, Math.min(this.egoColumn + 1, column)); at <= next; at++) {
      const ahead = at - time;
      const cell = this.ego * COLUMNS + at;
      this.x[cell] = pose.x + ahead * rate.x;
      this.y[cell] = pose.y + ahead * rate.y;
      const before = at && this.there[cell - 1] ? this.heading[cell - 1] : pose.heading;
      const heading = pose.heading + ahead * rate.heading;
      this.heading[cell] = before + turn(heading - before);
      this.there[cell] = 1;
    }
    this.egoColumn = column;
  }
}

/** The same angle within half a turn. */
function turn(angle) {
  return angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
}

export const ROLE = { EGO, INITIAL, INSERTED };
