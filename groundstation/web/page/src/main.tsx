/** The operator's page. */

import { render } from "preact";
import { startTheme } from "./colours";
import { Editor } from "./editor/Editor";
import "./keys";
import { KEYS } from "./keys";
import { connect } from "./link";
import { Question } from "./Question";
import { Alarms, Log } from "./panels/Alarms";
import { End } from "./panels/End";
import { Faults } from "./panels/Faults";
import { Header } from "./panels/Header";
import { Mission, MissionNews, Stopped } from "./panels/Mission";
import { OneRobot } from "./panels/OneRobot";
import { Plots, themeSerial } from "./panels/Plots";
import { Replay } from "./panels/Replay";
import { Runs } from "./panels/Runs";
import { Tiles } from "./panels/Tiles";
import { Tuning } from "./panels/Tuning";
import { Pool } from "./pool/Pool";
import { connected, editing, ended, scene } from "./store";
import "./style.css";

function Page() {
  return (
    <div class={connected.value || scene.value === null || ended.value ? "page" : "page lost"}>
      <Header />
      <Question />
      <main>
        <Pool />
        <aside>
          <div class="urgent">
            <Alarms />
            <Stopped />
          </div>
          <End />
          <Mission />
          {editing.value && <MissionNews />}
          {editing.value && <Editor />}
          <OneRobot />
          {!editing.value && <MissionNews />}
          <Faults />
          <Tiles />
          <Tuning />
          <Log />
          <details class="keys">
            <summary>Keys</summary>
            <dl>
              {KEYS.map(([keys, what]) => (
                <div key={keys}>
                  <dt>{keys}</dt>
                  <dd>{what}</dd>
                </div>
              ))}
            </dl>
          </details>
        </aside>
        <Runs />
        <Replay />
        <Plots />
      </main>
    </div>
  );
}

/** Paper is light. What stands on canvases is turned light by the style sheet: nothing is drawn again before it is printed. */
const root = document.documentElement.dataset;
addEventListener("beforeprint", () => {
  root["printed"] = root["theme"] ?? "dark";
  root["theme"] = "light";
  themeSerial.value += 1;
});
addEventListener("afterprint", () => {
  root["theme"] = root["printed"] ?? "dark";
  delete root["printed"];
  themeSerial.value += 1;
});

startTheme();
render(<Page />, document.getElementById("page")!);
connect();
