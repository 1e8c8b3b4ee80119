/** What measurements hook into (benchmarks/page.py); absent in use. */
interface Window {
  shoal?: { drawn?: (stateStampMs: number, pictureStampMs: number) => void; ready?: (drawSoon: () => void) => void };
}
