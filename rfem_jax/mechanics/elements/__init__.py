"""Forces of the spring-damping elements, linear and geometrically exact."""
