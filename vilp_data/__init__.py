"""Episode logs in, latent shards out. The walk of an episode: sources -> decode -> align -> episodes -> split -> latents -> dataset."""
