"""From a picture to an inflated shape, and back: structures drawn for a height, each verified by inflating it.

python examples/quickstart.py [picture.png]
"""

import sys

import numpy as np

from inflate_lib import describe, inflate, label_image, load_model, load_sevens
from inflate_lib.io import write_picture

# Forwards: a handwritten seven stands for a soft wall around a cavity, and pressure gives it its shape.
seven = load_sevens("digits").images[0]
structure = label_image(seven)  # 28 × 28 labels: outside, wall, void
shape = describe(inflate(structure))
print(f"a seven inflates to height {shape.height:.3f} and width {shape.width:.3f}, in sides of the frame")

# Backwards: which structures become 1.05 high? There are many, so a diffusion model draws fifty from noise.
wanted = 1.05
model = load_model("height", profile="laptop")  # trained weights from the repository
drawn = model.draw({"height": wanted}, n=50, seed=0)

# A drawing is a promise. The simulation that described the seven shows whether it is kept.
results = []
for image in drawn:
    try:
        results.append(inflate(label_image(image)))
    except ValueError:  # no closed wall that fits the frame
        continue
results = [result for result in results if result.converged]
heights = np.array([describe(result).height for result in results])
best = np.abs(heights - wanted).argmin()

print(f"{len(results)} of {len(drawn)} drawings inflate; wanted height {wanted}, on average {heights.mean():.3f}")
print(f"the best is {heights[best]:.4f} high, {100 * abs(heights[best] / wanted - 1):.3f} % off")
picture = write_picture(results[best], sys.argv[1] if len(sys.argv) > 1 else "quickstart.png")
print(f"before and after inflation: {picture}")
