"""The Allegro hand with a cube on its palm: facts and a light model."""
