/** The worker that labels, inflates, describes and refines. */

import { describe } from "./descriptors.ts";
import { inflate } from "./inflation.ts";
import { asGrey, type LabelOptions, labelImage } from "./labels.ts";
import { refine } from "./refine.ts";
import { answer } from "./remote.ts";
import { trySimulate } from "./simulate.ts";

type Args<F extends (...args: never[]) => unknown> = Parameters<F>;

answer({
  label: (_, image: unknown, options?: LabelOptions) => labelImage(image, options),
  inflate: (_, label: unknown, options?: Args<typeof inflate>[1]) => inflate(asGrey(label), options),
  describe: (_, ...args: Args<typeof describe>) => describe(...args),
  simulate: (_, ...args: Args<typeof trySimulate>) => trySimulate(...args),
  refine: (watch, ...[image, targets, options, goal, tries]: Args<typeof refine>) =>
    refine(image, targets, options, goal, tries, watch),
});
