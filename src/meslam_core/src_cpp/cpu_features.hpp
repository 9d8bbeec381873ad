// Which backends this CPU, its operating system and the user's cap allow.
#pragma once

#include <string>
#include <vector>

#include "backend.hpp"

namespace meslam {

// The environment variable that names the best instruction set to use.
constexpr const char* kCapVariable = "MESLAM_KERNEL_ISA";

// Best first. Throws std::invalid_argument when the cap names an unknown instruction set.
std::vector<const Backend*> available_backends();

// "auto" or a name. Throws std::invalid_argument for one that is unknown or not available.
const Backend* find_backend(const std::string& name);

}  // namespace meslam
