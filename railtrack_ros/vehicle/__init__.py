"""The vehicle: wheels, contact spring and the layout of the axle boxes."""
