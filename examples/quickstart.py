"""Structures for a wanted height: drawn by a diffusion model, verified by inflation.

python examples/quickstart.py [picture.png]
"""

import sys

import numpy as np

from inflate_lib import describe, find_flaw, inflate, label_image, load_sevens
from inflate_lib.io import write_picture
from inflate_lib.models import load_model

# Forwards: a handwritten seven stands for a soft wall around a cavity. Pressure
# inflates the cavity; the shape that comes out is measured in sides of the frame.
seven = load_sevens("digits").images[0]
shape = describe(inflate(label_image(seven)))
print(f"a seven inflates to height {shape.height:.3f}, width {shape.width:.3f}")

# Backwards: many structures become 1.05 high; a diffusion model draws fifty from noise.
wanted = 1.05
model = load_model("height", profile="laptop")  # trained weights of the repository
drawn = model.draw({"height": wanted}, n=50, seed=0)

results = []  # how near each comes is not known before it is inflated in turn
for image in drawn:
    try:
        results.append(inflate(label_image(image)))
    except ValueError:  # the drawing is no structure that fits the frame
        continue
results = [result for result in results if result.converged]
heights = np.array([describe(result).height for result in results])
buildable = [find_flaw(result) is None for result in results]
best = np.where(buildable, np.abs(heights - wanted), np.inf).argmin()
error = 100 * abs(heights[best] / wanted - 1)

print(f"{len(results)} of {len(drawn)} drawings inflate, to height {heights.mean():.3f}")
print(f"wanted {wanted}, achieved by the best {heights[best]:.4f}: {error:.3f} % off")
picture = write_picture(results[best], (sys.argv + ["quickstart.png"])[1])
print(f"the best of the {sum(buildable)} that can be built, inflated: {picture}")
