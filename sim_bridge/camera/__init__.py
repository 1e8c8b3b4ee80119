"""The simulated overhead camera: from the robots' state to a raw picture, through the water's surface.

Once per experiment: optics.py gives exact projection and lines of sight; rays.py keeps the lines of all pixels as float32
planes (height, width), and of BLOCK x BLOCK pixels as planes (block rows, block columns). textures.py draws tiles, hulls and
marker plates as BGR pictures. scene.py follows each line to floor, wall or deck and colours it (height, width, 3).

Then for each picture, in the order of renderer.py:

    1. background        static_background.py blends two of 48 cached raw mosaics (height, width) uint8.
                         moving_background.py remaps a plan of the basin, for a camera that moves.
                         Both bend lines by ripples, multiply caustic light and add glare (water_optics.py, on blocks).
    2. landmarks         marker plates (robot_sprite.py), each in its rectangle (ImageRect) of the mosaic
    3. shadows           darken the floor's rectangle under each robot (robot_sprite.py)
    4. robots and balls  the farthest first: sphere and plate as colour and coverage planes of the rectangle,
                         averaged over the exposure, laid over the mosaic (robot_sprite.py)
    5. noise             a copy of the mosaic with shot and read noise (sensor_noise.py)
    6. faults            frozen, dark, occluded, glare, bumped (faults.py), applied by the process

A mosaic is Bayer RGGB, (height, width) uint8, its first pixel red. Light is relative to its mean, colours are 0 to 255.
ideal_localizer.py stands for camera and localizer together: true poses with noise, without a picture.
"""
