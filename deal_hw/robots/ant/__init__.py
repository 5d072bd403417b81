"""The ant of gymnasium: facts and its model, prepared from the installed package."""
