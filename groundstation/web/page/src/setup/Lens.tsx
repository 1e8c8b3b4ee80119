/** Step 2: the lens, from views of a board that is waved in air. */

import { signal } from "@preact/signals";
import { ask, state, type State } from "./api";

const ENOUGH = 15; // corners in a cell from which on its colour stays
const WIDEST_DEG = 45;
const board = signal<string | null>(null);

export function LensOverlay({ s }: { s: State }) {
  const [width, height] = s.size_px;
  const { coverage, seen_px } = s.lens;
  const rows = coverage.length;
  const columns = coverage[0]?.length ?? 1;
  return (
    <>
      {coverage.flatMap((row, j) =>
        row.map((count, i) => (
          <rect
            key={`${i} ${j}`}
            class={count > 0 ? "covered" : "empty"}
            style={`fill-opacity: ${0.15 + (0.25 * Math.min(count, ENOUGH)) / ENOUGH}`}
            x={(i * width) / columns - 0.5}
            y={(j * height) / rows - 0.5}
            width={width / columns}
            height={height / rows}
          />
        )),
      )}
      {seen_px.map(([u, v], i) => (
        <circle key={i} class="seen" cx={u} cy={v} r={width / 220} />
      ))}
    </>
  );
}

function Tilts({ s }: { s: State }) {
  return (
    <svg class="tilts" viewBox={`${-WIDEST_DEG} ${-WIDEST_DEG} ${2 * WIDEST_DEG} ${2 * WIDEST_DEG}`} role="img" aria-label="Tilts of the board, 45 degrees each way">
      <circle class="ring" r={20} />
      <circle class="ring" r={40} />
      <path class="ring" d={`M${-WIDEST_DEG} 0H${WIDEST_DEG}M0 ${-WIDEST_DEG}V${WIDEST_DEG}`} />
      {s.lens.tilts_deg.map(([x, y], i) => (
        <circle key={i} class="tilt" cx={y} cy={x} r={2.5} />
      ))}
    </svg>
  );
}

export function Lens() {
  const s = state.value!;
  const text = board.value ?? s.lens.board;
  return (
    <>
      <section>
        <h2>Board</h2>
        <form
          class="row"
          onSubmit={(event) => {
            event.preventDefault();
            void ask("board", { board: text });
          }}
        >
          <input aria-label="Board" value={text} onInput={(event) => (board.value = event.currentTarget.value)} />
          <button type="submit" disabled={text === s.lens.board}>
            Take it
          </button>
        </form>
        <p class="dim">chessboard:9x6:0.03 (inner corners, m) or charuco:7x5:0.04:0.03:DICT_4X4_50 (squares, m)</p>
      </section>
      <section>
        <h2>
          Views
          <button type="button" aria-pressed={s.lens.collecting} onClick={() => void ask("collect", { on: !s.lens.collecting })}>
            {s.lens.collecting ? "Stop collecting" : "Collect"}
          </button>
        </h2>
        <p role="status">{s.lens.collecting ? s.lens.said : "Collect, and hold the board still, in air, at one place and tilt after the other."}</p>
        <div class="row">
          <Tilts s={s} />
          <div>
            <p>
              <b>{s.lens.views.length}</b> views
            </p>
            <ul class="missing">
              {s.lens.missing.map((what) => (
                <li key={what}>{what}</li>
              ))}
            </ul>
          </div>
        </div>
        <details>
          <summary>Views</summary>
          <ul class="list">
            {s.lens.views.map((name) => (
              <li key={name}>
                {name}
                <button type="button" aria-label={`Remove ${name}`} onClick={() => void ask("drop-view", { name })}>
                  ✕
                </button>
              </li>
            ))}
          </ul>
        </details>
        <button type="button" class="main" disabled={s.lens.views.length < 5} onClick={() => void ask("fit-lens")}>
          Find the lens
        </button>
        {s.lens.report.length > 0 && <pre tabIndex={0}>{s.lens.report.join("\n")}</pre>}
      </section>
    </>
  );
}
