"""A plant as one MATLAB file: a function that simulates, and a Level-2 S-function for Simulink."""

from __future__ import annotations

from collections.abc import Sequence

from thermoctl import __version__
from thermoctl.export.text import Notation, unique, written
from thermoctl.export.values import Values, first_outputs
from thermoctl.plant.equations import Equations
from thermoctl.plant.expression import Expr
from thermoctl.plant.expression import names as names_in
from thermoctl.plant.language import Plant
from thermoctl.yamlfile import InputError

_FUNCTIONS = {f: f"{f}({{0}})" for f in ("abs", "sqrt", "exp", "log", "sin", "cos", "tanh")}


def _jump(op: str, z: str, width: str) -> str:
    return f"{'sign_' if op == 'sign' else 'strict_' if op in ('<', '>') else 'step_'}({z}, {width})"


NOTATION = Notation(
    "{0} ^ {1}",
    {**_FUNCTIONS, "min": "min({0}, {1})", "max": "max({0}, {1})"},
    _jump,
    {"==": "double({0} == {1})", "!=": "double({0} ~= {1})"},
    lambda x, xs, ys: f"table_({x}, [{', '.join(xs)}], [{', '.join(ys)}])",
)
_WORDS = """
break case catch classdef continue else elseif end for function global if otherwise parfor persistent return
spmd switch try while t x u p w first block setup start derivatives outputs slopes initial defaults sign_
step_ strict_ table_ run abs sqrt exp log sin cos tanh min max double pi i j
"""
_RESERVED = set(_WORDS.split())


def matlab_source(plant: Plant, numbers: Values, function: str) -> str:
    """Return the file of `function`. Raises InputError for a plant with delay()."""
    e = Equations(plant)
    if e.input_delays or e.output_delays:
        raise InputError(
            f"{plant.file}: an S-function has no delay(); give --to fmu, which Simulink reads, or put a Transport Delay "
            "block in its place"
        )
    names = {**unique(plant, _RESERVED | {function}), "t": "t"}
    width = {id(z): f"w({k})" for k, (z, _) in enumerate(e.jumps, 1)}
    asked = first_outputs(plant)
    first = names | {o: f"first({k})" for k, o in enumerate(asked, 1)}

    def text(expr: Expr) -> str:
        """Return an expression in MATLAB."""
        return written(expr, NOTATION, names.__getitem__, lambda z: width.get(id(z), "0"), first.__getitem__)

    def unpack(keys: Sequence[str], array: str) -> str:
        """Return the assignments of an array's elements to their names."""
        return "".join(f"{names[k]} = {array}({n});\n" for n, k in enumerate(keys, 1))

    get_p, get_x, get_u = unpack(e.parameters, "p"), unpack(e.states, "x"), unpack(tuple(plant.inputs), "u")
    flows = "".join(f"{names[f'flow {f.name}']} = {text(f.rate)};\n" for f in plant.flows.values())
    slopes = []
    for k, n in enumerate(plant.nodes.values(), 1):
        parts = [f"+ {names[f'flow {f.name}']}" for f in plant.flows.values() if f.target == n.name]
        parts += [f"- {names[f'flow {f.name}']}" for f in plant.flows.values() if f.source == n.name]
        slopes.append(f"dx({k}) = ({' '.join(parts).removeprefix('+ ')}) / ({text(n.storage)});\n")
    starts = [f"x({k}) = {text(n.initial)};\n" for k, n in enumerate(plant.nodes.values(), 1)]
    values = [f"y({k}) = {text(v)};\n" for k, v in enumerate(e.values, 1)]
    listed = "".join(
        f"p({k}) = {numbers.parameters[q.name]!r};  % {q.name}{f' [{q.unit}]' if q.unit else ''}\n"
        for k, q in enumerate(plant.parameters.values(), 1)
    )
    linear = " ".join(str(int(i.linear)) for i in plant.inputs.values())
    direct = int(any(set(plant.inputs) & names_in(v) for v in e.values))
    return _FILE.format(
        name=function,
        title=(plant.title or plant.file).replace("\n", " "),
        version=__version__,
        inputs=", ".join(plant.inputs),
        outputs=", ".join(plant.outputs),
        states=", ".join(plant.nodes),
        nu=len(plant.inputs),
        nx=len(e.states),
        ny=len(e.outputs),
        np=len(e.parameters),
        linear=linear,
        direct=direct,
        defaults=listed,
        widths=" ".join(map(repr, numbers.width)),
        first=" ".join(repr(numbers.first[o]) for o in asked),
        scale=" ".join(map(repr, numbers.scale)),
        initial=get_u + get_p + "".join(starts),
        slopes=get_x + get_u + get_p + flows + "".join(slopes),
        values=get_x + get_u + get_p + "".join(values),
    )


_FILE = """\
function varargout = {name}(varargin)
% {title}
% Written by `thermoctl plant export --to simulink-m` (thermoctl {version}).
%
% y = {name}(t, u, p)   simulates: t (N,1) seconds, u (N,{nu}) inputs, y (N,{ny}) outputs; p: parameters, [] the defaults
% [y, x] = ...          also the states
% In Simulink: block "Level-2 MATLAB S-Function" with the name {name}.
%
% inputs:  {inputs}
% states:  {states}
% outputs: {outputs}
if ~isnumeric(varargin{{1}})
  setup(varargin{{1}});
  return
end
p = defaults();
if nargin > 2 && ~isempty(varargin{{3}})
  p = varargin{{3}};
end
[varargout{{1:max(nargout, 1)}}] = run(varargin{{1}}(:), varargin{{2}}, p);
end

function p = defaults()
p = zeros({np}, 1);
{defaults}end

function x = initial(u, p)
first = [{first}];
x = zeros({nx}, 1);
{initial}end

function dx = slopes(t, x, u, p)
w = [{widths}];  % half widths over which jumps are smoothed; 0: not smoothed
dx = zeros({nx}, 1);
{slopes}end

function y = readings(t, x, u, p)
w = [{widths}];
y = zeros({ny}, 1);
{values}end

function [y, x] = run(t, u, p)
t = t - t(1);
linear = logical([{linear}]);
n = numel(t);
x = zeros(n, {nx});
y = zeros(n, {ny});
if {nx} > 0
  x(1, :) = initial(u(1, :), p);
  scale = [{scale}];
  if isempty(scale)
    scale = abs(x(1, :)) + 1e-3;
  end
  changes = find(any(diff(u(:, ~linear), 1, 1) ~= 0, 2)) + 1;
  edges = unique([1; changes; n]);
  options = odeset('RelTol', 1e-9, 'AbsTol', 1e-9 * scale(:));
  for k = 1:numel(edges) - 1
    a = edges(k); b = edges(k + 1);
    times = t(a:b);
    if numel(times) == 2
      times = [times(1); mean(times); times(2)];
    end
    [~, found] = ode15s(@(s, z) slopes(s, z, between(s, t, u, linear, a, b), p), times, x(a, :)', options);
    if b == a + 1
      found = found([1 end], :);
    end
    x(a:b, :) = found;
  end
end
for k = 1:n
  y(k, :) = readings(t(k), x(k, :), u(k, :), p);
end
end

function now = between(s, t, u, linear, a, b)
now = u(a, :);
k = min(max(find(t <= s, 1, 'last'), a), b - 1);
now(linear) = u(k, linear) + (s - t(k)) / (t(k + 1) - t(k)) * (u(k + 1, linear) - u(k, linear));
end

function s = sign_(z, w)
if w > 0, s = tanh(z / w); else, s = sign(z); end
end

function s = step_(z, w)
if w > 0, s = 0.5 * (1 + tanh(z / w)); else, s = double(z >= 0); end
end

function s = strict_(z, w)
if w > 0, s = 0.5 * (1 + tanh(z / w)); else, s = double(z > 0); end
end

function y = table_(x, xs, ys)
y = interp1(xs, ys, min(max(x, xs(1)), xs(end)));
end

% ---- Simulink
function setup(block)
block.NumInputPorts = {nu} > 0;
block.NumOutputPorts = 1;
block.SetPreCompPortInfoToDefaults;
if {nu} > 0
  block.InputPort(1).Dimensions = {nu};
  block.InputPort(1).DirectFeedthrough = {direct};
end
block.OutputPort(1).Dimensions = {ny};
block.NumContStates = {nx};
block.SampleTimes = [0 0];
block.RegBlockMethod('InitializeConditions', @start);
block.RegBlockMethod('Outputs', @outputs);
block.RegBlockMethod('Derivatives', @derivatives);
end

function u = input_of(block)
u = zeros(1, {nu});
if {nu} > 0
  u = block.InputPort(1).Data;
end
end

function start(block)
block.ContStates.Data = initial(input_of(block), defaults());
end

function outputs(block)
block.OutputPort(1).Data = readings(block.CurrentTime, block.ContStates.Data, input_of(block), defaults());
end

function derivatives(block)
block.Derivatives.Data = slopes(block.CurrentTime, block.ContStates.Data, input_of(block), defaults());
end
"""
