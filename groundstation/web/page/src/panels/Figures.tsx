/** Clearances, speeds and forces of a plan, beside what is allowed. */

import type { PlanFigure } from "../wire";

export function Figures({ figures }: { figures: PlanFigure[] }) {
  return (
    <table class="figures" aria-label="Figures of the plan">
      <tbody>
        {figures.map(({ what, unit, value, limit, least }) => (
          <tr key={what} class={least && value < limit - 1e-6 ? "no" : ""}>
            <th scope="row">{what}</th>
            <td>
              {value.toFixed(2)} {unit}
            </td>
            <td class="limit">
              {least ? "≥" : "≤"} {limit.toFixed(2)}
            </td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}
