"""The unit check of a plant, by dimension."""
def check_units(plant):
    """To be written by PLANT+."""
