"""An object followed in plain videos of unknown cameras, in pixels: the correlation filter without pool, marker and gates."""
