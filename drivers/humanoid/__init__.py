"""The humanoid of dm_control: facts and its model, prepared from the installed package."""
