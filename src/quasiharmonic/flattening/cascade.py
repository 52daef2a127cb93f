"""stub"""
def coarse_start(*a): return None
