"""SafeVar on SUMO: which smallest variations of a vehicle make its automated driving system unsafe?"""
