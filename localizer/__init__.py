"""SHELL: camera frame -> poses (docs/cameras.md).

OpenCV reads its limit of a picture's size when it is loaded, which is after this: a file of 100 kB may say that it holds a
gigapixel, and its own limit would let that take 3 GB.
"""

import os

os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))  # 134 million; the largest cameras have 100
