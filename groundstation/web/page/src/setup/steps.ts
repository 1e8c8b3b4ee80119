/** The steps of a setup, in their order; the one that is shown is in the address. */

import { signal } from "@preact/signals";

export const STEPS = ["Picture", "Lens", "Survey", "Masks", "Save"] as const;
export type Step = (typeof STEPS)[number];

export const step = signal<Step>("Picture");
