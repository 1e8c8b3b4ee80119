/** A field for a number. What a person is typing stays as it is: "1." is the number 1, and to show that would swallow the point.
 * Without a number in it `onEmpty` is called; where that is not given, the last number counts on, and is shown when the field is left. */

import { useLayoutEffect, useRef } from "preact/hooks";

interface Given {
  value: number; // NaN: none
  onNumber: (value: number) => void;
  onEmpty?: () => void;
  step: number;
  min?: number;
  class?: string;
  disabled?: boolean;
  "aria-label"?: string;
}

export function NumberInput({ value, onNumber, onEmpty, ...more }: Given) {
  const field = useRef<HTMLInputElement>(null);
  const show = () => {
    if (field.current !== null) field.current.value = Number.isNaN(value) ? "" : String(Number(value.toFixed(4))); // null: it goes away with the focus on it
  };
  useLayoutEffect(() => {
    const typed = field.current!.valueAsNumber;
    if (document.activeElement !== field.current || !(Number.isNaN(typed) || typed === value)) show();
  });
  return (
    <input
      {...more}
      ref={field}
      type="number"
      onInput={(event) => (Number.isFinite(event.currentTarget.valueAsNumber) ? onNumber(event.currentTarget.valueAsNumber) : onEmpty?.())}
      onBlur={show}
    />
  );
}
