/** Numbers in messages, written as Python writes them, so that both implementations refuse in the same words. */

/** A number with so many significant digits, as Python's format `g` has it: 0.5, 1.234e-05, 12. */
export function general(value: number, digits = 6): string {
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "nan" : value > 0 ? "inf" : "-inf";
  if (value === 0) return "0";
  const [mantissa = "0", power = "0"] = value.toExponential(digits - 1).split("e");
  const exponent = Number(power);
  const short = (text: string) => (text.includes(".") ? text.replace(/\.?0+$/, "") : text);
  if (exponent < -4 || exponent >= digits) {
    const sign = exponent < 0 ? "-" : "+";
    return `${short(mantissa)}e${sign}${String(Math.abs(exponent)).padStart(2, "0")}`;
  }
  return short(value.toFixed(digits - 1 - exponent));
}

/** "1 hole", "2 holes". */
export function counted(n: number, noun: string): string {
  return `${n} ${noun}${n === 1 ? "" : "s"}`;
}

/** What is wrong with something that the reader gave: a sentence that is shown, not a bug. */
export class Refusal extends Error {
  override name = "Refusal";
}
