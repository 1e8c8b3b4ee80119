/** The page of `localizer setup`. */

import { render } from "preact";
import { isLight, setTheme, startTheme } from "../colours";
import { problem, reachable, state, watch } from "./api";
import { Lens } from "./Lens";
import { Light } from "./Light";
import { Masks } from "./Masks";
import { Picture } from "./Picture";
import { Save } from "./Save";
import "./setup.css";
import { step, STEPS } from "./steps";
import { Stop } from "./Stop";
import { Survey } from "./Survey";

const PANELS = { Picture: Light, Lens, Survey, Masks, Save };

function Page() {
  const s = state.value;
  const Panel = PANELS[step.value];
  return (
    <>
      <header>
        <h1>Camera of {s?.experiment ?? "..."}</h1>
        <span class="dim">{s?.source}</span>
        <nav aria-label="Steps">
          {STEPS.map((name, k) => (
            <button key={name} type="button" aria-pressed={step.value === name} onClick={() => (step.value = name)}>
              {k + 1} {name}
            </button>
          ))}
        </nav>
        <button type="button" class="theme" onClick={() => setTheme(isLight() ? "dark" : "light")}>
          Light or dark
        </button>
        <Stop />
      </header>
      <main>
        <Picture />
        <aside>
          {problem.value !== "" && (
            <p class="problem" role="alert">
              {problem.value}
            </p>
          )}
          {reachable.value && s?.said.map((line) => <p key={line} class="said" role="status">{line}</p>)}
          {s !== null && <Panel />}
        </aside>
      </main>
    </>
  );
}

startTheme();
render(<Page />, document.getElementById("page")!);
void watch();
