"""Files in and out: readers return checked NumPy records; whatever is wrong with a file becomes one InputError."""

from ncs_jax.io.animation.animation import read_animation, write_animation
from ncs_jax.io.character.body import read_body
from ncs_jax.io.character.motion import read_motion
from ncs_jax.io.character.moving_body import is_moving_body, read_moving_body
from ncs_jax.io.character.smpl_model import read_betas
from ncs_jax.io.character.write_body import write_body
from ncs_jax.io.mesh.garment import read_garment, write_garment
from ncs_jax.io.mesh.joined import worn_together
from ncs_jax.io.records import AnimationRecord, BodyRecord, GarmentRecord, MotionRecord

__all__ = [
    "AnimationRecord",
    "BodyRecord",
    "GarmentRecord",
    "MotionRecord",
    "is_moving_body",
    "read_animation",
    "read_betas",
    "read_body",
    "read_garment",
    "read_motion",
    "read_moving_body",
    "worn_together",
    "write_animation",
    "write_body",
    "write_garment",
]
