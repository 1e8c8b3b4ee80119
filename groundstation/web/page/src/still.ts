/** Keeps what the pointer is on in its place while things above it come and go: nobody presses what was elsewhere a moment ago.
 * What a click itself brings may move things. All of them are where they belong again when the pointer leaves, or scrolls. */

const TARGETS = "button, input, select, summary, a";
const CLICK_MS = 300; // in which the page has drawn what a click brings

/** Do so in a column of `panels`, which scrolls. Where the page is narrow nothing is shifted: there is no column. */
export function keepStill(column: HTMLElement, panels: HTMLElement): void {
  let [held, topPx, shiftPx, clickedMs]: [Element | null, number, number, number] = [null, 0, 0, -Infinity];
  let at: [x: number, y: number] = [0, 0];
  const look = () => (topPx = held?.getBoundingClientRect().top ?? 0);
  /** What shrinks must not scroll the column. */
  const lock = (morePx = 0) => (panels.style.minHeight = `${panels.offsetHeight + morePx}px`);
  const release = () => {
    [held, shiftPx] = [null, 0];
    panels.style.marginTop = panels.style.minHeight = "";
  };
  const take = () => {
    const on = document.elementFromPoint(...at); // a button that is disabled gets no events of its own
    held = panels.contains(on) ? (on!.closest(TARGETS) ?? on!.closest("section")) : null;
    if (held === null) return release();
    look();
    lock();
  };
  const keep = () => {
    if (held === null || !held.isConnected || getComputedStyle(panels).display === "contents") return;
    const movedPx = held.getBoundingClientRect().top - topPx;
    lock(Math.max(movedPx, 0));
    if (movedPx !== 0) panels.style.marginTop = `${(shiftPx -= movedPx)}px`;
  };
  column.addEventListener("pointermove", (event) => {
    at = [event.clientX, event.clientY];
    if (performance.now() - clickedMs > CLICK_MS) take();
  });
  column.addEventListener("click", () => {
    [held, clickedMs] = [null, performance.now()];
    setTimeout(take, CLICK_MS);
  });
  column.addEventListener("pointerleave", () => ((at = [-1, -1]), release()));
  column.addEventListener("wheel", release, { passive: true });
  column.addEventListener("scroll", look);
  new MutationObserver(keep).observe(column, { subtree: true, childList: true, characterData: true, attributeFilter: ["class", "open"] });
}
