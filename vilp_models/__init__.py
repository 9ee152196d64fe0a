"""The models, trained from vilp_data's stores: the VQGAN that turns frames into latents, and what measures it."""
