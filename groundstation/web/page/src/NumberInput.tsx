/** A field for a number. What a person is typing stays as it is: "1." is the number 1, and to show that would swallow the point. */

import { useLayoutEffect, useRef } from "preact/hooks";

interface Given {
  value: number;
  onNumber: (value: number) => void;
  step: number;
  min?: number;
  "aria-label"?: string;
}

export function NumberInput({ value, onNumber, ...more }: Given) {
  const field = useRef<HTMLInputElement>(null);
  const show = () => {
    if (field.current !== null) field.current.value = String(Number(value.toFixed(4))); // null: it goes away with the focus on it
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
      onInput={(event) => Number.isFinite(event.currentTarget.valueAsNumber) && onNumber(event.currentTarget.valueAsNumber)}
      onBlur={show}
    />
  );
}
