interface Window {
  /** What measurements hook into (benchmarks/page.py); absent in use. */
  shoal?: { drawn?: (stateStampMs: number, pictureStampMs: number) => void; ready?: (drawSoon: () => void) => void };
  /** Figures for a paper, once report/templates/paper.js is loaded. */
  paper?: { save(drawing: object, name: string, what: string): Promise<void> };
}

declare module "*/paper.js";
