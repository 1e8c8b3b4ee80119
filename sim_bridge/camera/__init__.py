"""The simulated overhead camera: from the robots' state to a raw picture, through the water's surface.

Once per experiment: optics.py gives exact projection and lines of sight; rays.py keeps the lines of all blocks of BLOCK x
BLOCK pixels as float32 planes (block rows, block columns). textures.py draws tiles, hulls and marker plates as BGR pictures.
scene.py follows each line to floor, wall or deck and colours it (height, width, 3).

Then for each picture, in the order of renderer.py (kernels: kernels.py, compiled loops over pixels):

    1. background        static_background.py blends two of 48 cached raw mosaics (height, width) uint8,
                         lit by two of 60 caustic patterns.
                         moving_background.py remaps a plan of the basin, for a camera that moves.
                         Both bend lines by ripples, multiply caustic light and add glare (water_optics.py, on blocks).
    2. landmarks         marker plates, each in its rectangle (ImageRect) of the mosaic (robot_sprite.py, as 4.)
    3. shadows           darken the floor's rectangle under each robot (kernels.draw_shadow)
    4. robots and balls  the farthest first, each in its rectangle (robot_sprite.py, kernels.draw_body). Bent lines of sight,
                         light and glare are computed at blocks (water_optics.block_fields) and interpolated. For each pixel
                         and each part of the exposure: line -> plate, sphere -> texture -> light, gloss -> water; then the
                         mean of the parts over the background by its coverage, vignette and glare
    5. bubbles           specks of light, where there are any (bubbles.py)
    6. noise             a copy of the mosaic with shot and read noise (sensor_noise.py, kernels.add_noise)
    7. faults            frozen, dark, occluded, glare, bumped (faults.py), applied by the process

A mosaic is Bayer RGGB, (height, width) uint8, its first pixel red. Light is relative to its mean, colours are 0 to 255.
"""
