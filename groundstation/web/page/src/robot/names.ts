/** Robots of which the same is said, said once. */

/** Items with the same words, together, in the order in which the words came first. */
export function together<T>(items: T[], words: (item: T) => string): [T, ...T[]][] {
  const found = new Map<string, [T, ...T[]]>();
  for (const item of items) {
    const same = found.get(words(item));
    if (same === undefined) found.set(words(item), [item]);
    else same.push(item);
  }
  return [...found.values()];
}

/** "robot 3", "robots 1, 2, 7", "robots 1 to 20, 25". */
export function robotNames(ids: number[]): string {
  return `robot${ids.length > 1 ? "s" : ""} ${numbers(ids)}`;
}

/** "3", "1, 2, 7", "1 to 20, 25". */
export function numbers(ids: number[]): string {
  const runs: [first: number, last: number][] = [];
  for (const id of [...ids].sort((a, b) => a - b)) {
    const run = runs.at(-1);
    if (run !== undefined && id === run[1] + 1) run[1] = id;
    else runs.push([id, id]);
  }
  const texts = runs.flatMap(([first, last]) => (last - first < 2 ? (last > first ? [`${first}`, `${last}`] : [`${first}`]) : [`${first} to ${last}`]));
  return texts.join(", ");
}
