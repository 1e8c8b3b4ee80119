/** Step 1: light, focus, blur and rate, and the camera's own controls. */

import { signal } from "@preact/signals";
import { ask, type Control, type Figures, state, type Verdict } from "./api";

const sliding = signal<{ name: string; value: number } | null>(null); // the slider that is held: the camera's answer comes later

export function Say({ verdict }: { verdict: Verdict }) {
  return (
    <p class={verdict.good ? "verdict yes" : "verdict no"}>
      <b>{verdict.good ? "✓" : "!"}</b> {verdict.text}
    </p>
  );
}

function Histogram({ figures }: { figures: Figures }) {
  const most = Math.max(...figures.histogram.slice(1, -1), 0.02);
  return (
    <svg class="histogram" viewBox="0 0 64 30" preserveAspectRatio="none" role="img" aria-label="Histogram of brightness, dark on the left">
      {figures.histogram.map((share, i) => {
        const tall = Math.min(share / most, 1) * 30;
        return <rect key={i} class={i === 0 || i === 63 ? "end" : ""} x={i} y={30 - tall} width={0.9} height={tall} />;
      })}
    </svg>
  );
}

function Slider({ control }: { control: Control }) {
  const set = (value: number) => ask("control", { name: control.name, value });
  const value = sliding.value?.name === control.name ? sliding.value.value : control.value;
  const label = control.name.replaceAll("_", " ");
  const isSwitch = control.minimum === 0 && control.maximum === 1 && control.choices.length === 0;
  return (
    <label class="control">
      <span>{label}</span>
      {control.choices.length > 0 ? (
        <select disabled={!control.usable} value={control.value} onChange={(event) => void set(Number(event.currentTarget.value))}>
          {control.choices.map(([value, name]) => (
            <option key={value} value={value}>
              {name}
            </option>
          ))}
        </select>
      ) : isSwitch ? (
        <input type="checkbox" disabled={!control.usable} checked={control.value === 1} onChange={(event) => void set(event.currentTarget.checked ? 1 : 0)} />
      ) : (
        <input
          type="range"
          disabled={!control.usable}
          min={control.minimum}
          max={control.maximum}
          step={control.step}
          value={value}
          onInput={(event) => (sliding.value = { name: control.name, value: event.currentTarget.valueAsNumber })}
          onChange={(event) => void set(event.currentTarget.valueAsNumber).then(() => (sliding.value = null))}
        />
      )}
      <span class="value">{control.choices.length === 0 && value}</span>
    </label>
  );
}

export function Light() {
  const s = state.value!;
  return (
    <>
      <section>
        <h2>
          Light and focus
          <button type="button" onClick={() => void ask("focus")} title="Another scene is in sight: the best focus so far no longer counts">
            New best
          </button>
        </h2>
        {s.figures !== null && <Histogram figures={s.figures} />}
        {s.figures?.verdicts.map((verdict) => <Say key={verdict.text} verdict={verdict} />)}
        <Say verdict={s.rate} />
      </section>
      <section>
        <h2>
          Controls
          <button type="button" disabled={s.controls.length === 0} onClick={() => void ask("defaults")}>
            Defaults
          </button>
        </h2>
        {s.no_controls !== "" && <p class="dim">{s.no_controls}</p>}
        {s.controls.map((control) => (
          <Slider key={control.name} control={control} />
        ))}
      </section>
    </>
  );
}
