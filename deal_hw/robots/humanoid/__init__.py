"""The humanoid of dm_control: facts and its model, prepared from a copy of the published file."""
