// A board of buttons. One of them is reached by Tab; arrow keys go on from there, Enter and Space click.
const CHESS = { k: "♚", q: "♛", r: "♜", b: "♝", n: "♞", p: "♟" };

export default {
  template: `
    <div class="board" :class="['is-' + pieces, playable ? 'is-playable' : '', 'side-' + side]" role="grid" :aria-label="name"
         :style="{ '--rows': rows.length, '--columns': rows[0].length, '--names': namesWidth }" @keydown="onKey">
      <div v-for="(squares, row) in rows" role="row" class="board-row" :style="{ '--row': row }">
        <span class="name" aria-hidden="true">{{ rowNames[row] }}</span>
        <button v-for="(piece, column) in squares" type="button" role="gridcell" class="square" :key="column"
                :class="classes(row, column)" :data-square="row + ',' + column" :aria-label="labels[row][column]"
                :tabindex="row === at[0] && column === at[1] ? 0 : -1"
                @focus="at = [row, column]" @click="$emit('square', [row, column])">
          <svg v-if="pieces === 'marks' && piece === 'X'" class="piece first" viewBox="0 0 40 40" aria-hidden="true">
            <path d="M10 10 L30 30 M30 10 L10 30" /></svg>
          <svg v-else-if="pieces === 'marks' && piece === 'O'" class="piece second" viewBox="0 0 40 40" aria-hidden="true">
            <circle cx="20" cy="20" r="11" /></svg>
          <svg v-else-if="round && (piece === 'X' || piece === 'O' || pieces === 'discs')" aria-hidden="true" viewBox="0 0 40 40"
               class="piece" :class="piece === 'X' ? 'first' : piece === 'O' ? 'second' : 'hole'">
            <circle cx="20" cy="20" r="16" /><circle v-if="piece" class="rim" cx="20" cy="20" :r="piece === 'X' ? 11 : 7" /></svg>
          <span v-else-if="piece" class="piece text" :class="owner(piece)" aria-hidden="true">{{ shown(piece) }}</span>
          <span v-if="share(row, column) !== undefined" class="share" aria-hidden="true"
                :style="{ '--share': share(row, column) }">{{ percent(share(row, column)) }}<span class="sign">%</span></span>
        </button>
      </div>
      <div class="board-row names" aria-hidden="true" :style="{ '--row': rows.length - 1 }">
        <span class="name"></span><span v-for="each in columnNames" class="name">{{ each }}</span>
      </div>
    </div>`,
  props: {
    name: String,
    pieces: String,
    rows: Array,
    rowNames: Array,
    columnNames: Array,
    labels: Array,
    last: Array,
    pending: Array,
    shares: Array,
    line: Array,
    playable: Boolean,
    arrows: Boolean, // whether arrow keys are the moves of this game
    side: Number,
  },
  emits: ["square", "press"],
  data() {
    return { at: [Math.floor(this.rows.length / 2), Math.floor(this.rows[0].length / 2)] };
  },
  computed: {
    round() {
      return ["discs", "stones", "go", "hex"].includes(this.pieces);
    },
    namesWidth() {
      return this.rowNames.some((each) => each.length > 2) ? "2.5rem" : "1.25rem";
    },
    byPlace() {
      return Object.fromEntries((this.shares ?? []).map(([row, column, share]) => [row + "," + column, share]));
    },
  },
  methods: {
    share(row, column) {
      return this.byPlace[row + "," + column];
    },
    percent(share) {
      return share >= 0.995 ? "100" : share < 0.005 ? "<1" : Math.round(100 * share).toString();
    },
    classes(row, column) {
      const here = (square) => square && square[0] === row && square[1] === column;
      return {
        dark: (row + column) % 2 === 1,
        empty: !this.rows[row][column],
        last: here(this.last),
        chosen: (this.pending ?? []).some(here),
        line: (this.line ?? []).some(here),
      };
    },
    owner(piece) {
      if (piece === "X" || piece === "O") return piece === "X" ? "first" : "second";
      return piece === piece.toUpperCase() ? "first" : "second";
    },
    shown(piece) {
      return this.pieces === "chess" ? (CHESS[piece.toLowerCase()] ?? piece) + "\uFE0E" : piece;
    },
    onKey(event) {
      const [row, column] = this.at;
      const [bottom, right] = [this.rows.length - 1, this.rows[0].length - 1];
      const to = {
        ArrowUp: [Math.max(row - 1, 0), column],
        ArrowDown: [Math.min(row + 1, bottom), column],
        ArrowLeft: [row, Math.max(column - 1, 0)],
        ArrowRight: [row, Math.min(column + 1, right)],
        Home: [row, 0],
        End: [row, right],
      }[event.key];
      if (event.key === "Escape" && this.pending?.length) this.$emit("square", this.pending[this.pending.length - 1]);
      if (!to || event.altKey || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      if (this.arrows && event.key.startsWith("Arrow")) return this.$emit("press", event.key.slice(5).toLowerCase());
      this.at = to;
      this.$el.querySelector(`[data-square="${to[0]},${to[1]}"]`).focus();
    },
  },
};
