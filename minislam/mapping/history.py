"""What the mapper did, iteration by iteration, for plots."""

from dataclasses import dataclass, field

from minislam.mapping.losses import RenderLoss


@dataclass
class MappingHistory:
    """One entry per iteration."""

    render: list[float] = field(default_factory=list)  # L_render
    color: list[float] = field(default_factory=list)  # weighted L_color
    depth: list[float] = field(default_factory=list)  # weighted L_depth
    isotropic: list[float] = field(default_factory=list)  # L_iso
    uncertainty: list[float] = field(default_factory=list)  # L_uncer, nan where frozen or off
    gaussians: list[int] = field(default_factory=list)  # size of the map

    def add(self, loss: RenderLoss, uncertainty: float, gaussians: int) -> None:
        """Append one iteration."""
        self.render.append(float(loss.total.detach()))
        self.color.append(float(loss.color.detach()))
        self.depth.append(float(loss.depth.detach()))
        self.isotropic.append(float(loss.isotropic.detach()))
        self.uncertainty.append(uncertainty)
        self.gaussians.append(gaussians)
