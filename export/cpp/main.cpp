// One image through a model of `torchmembrane export`: status, wrench, pressure and contacts, in words.
//
//     frame MODEL.onnx IMAGE.pgm
//
// The image is 8-bit grey (PGM, P5). Exit code: 0 a surface, 1 none, 2 wrong usage, model or image.
#include <onnxruntime_cxx_api.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

struct Image {
    int64_t width, height;
    std::vector<float> grey;  // 0..1, row by row
};

// A number of a PGM's header, after white space and comments.
int64_t header_number(std::istream& file) {
    while ((file >> std::ws) && file.peek() == '#') file.ignore(std::numeric_limits<std::streamsize>::max(), '\n');
    int64_t number = 0;
    file >> number;
    return number;
}

Image read_pgm(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    char kind[2] = {};
    file.read(kind, 2);
    const int64_t width = header_number(file), height = header_number(file), white = header_number(file);
    file.get();
    constexpr int64_t longest = 1 << 14;
    const bool sized = width > 0 && height > 0 && width <= longest && height <= longest;
    if (!file || kind[0] != 'P' || kind[1] != '5' || white != 255 || !sized)
        throw std::runtime_error(path + ": no 8-bit grey image; expected a binary PGM (P5) of at most 255");
    std::vector<uint8_t> bytes(static_cast<size_t>(width * height));
    if (!file.read(reinterpret_cast<char*>(bytes.data()), static_cast<std::streamsize>(bytes.size())))
        throw std::runtime_error(path + ": ends before its last pixel");
    Image image{width, height, std::vector<float>(bytes.size())};
    for (size_t i = 0; i < bytes.size(); ++i) image.grey[i] = static_cast<float>(bytes[i] / 255.0);
    return image;
}

// What the model says of its sensor, and its results of one image.
class Model {
  public:
    explicit Model(const std::string& path)
        : session_(environment_, path.c_str(), one_thread()), known_(session_.GetModelMetadata()) {
        if (known("format") != "1") throw std::runtime_error(path + ": no model of `torchmembrane export`, format 1");
        const std::string image = session_.GetInputNameAllocated(0, allocator_).get();
        if (image.rfind("image_", 0) == 0)
            throw std::runtime_error(path + ": takes an image for each view; expected a model of one image per frame");
        if (session_.GetInputCount() != 1)
            throw std::runtime_error(path + ": starts from the frame before; expected one exported without --tracking");
        size_ = session_.GetInputTypeInfo(0).GetTensorTypeAndShapeInfo().GetShape();  // batch, 1, height, width
        if (size_.size() != 4) throw std::runtime_error(path + ": takes no images; expected a model of `torchmembrane export`");
    }

    void run(Image& image) {
        if (image.height != size_[2] || image.width != size_[3])
            throw std::runtime_error("the image is " + std::to_string(image.width) + " x " + std::to_string(image.height) +
                                     " px, the sensor's are " + std::to_string(size_[3]) + " x " + std::to_string(size_[2]));
        const std::array<int64_t, 4> shape{1, 1, image.height, image.width};
        const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
        const auto input = Ort::Value::CreateTensor<float>(memory, image.grey.data(), image.grey.size(), shape.data(), 4);
        const char* image_name = "image";
        results_ = session_.Run(Ort::RunOptions{}, &image_name, &input, 1, names_.data(), names_.size());
    }

    template <class Value = float>
    const Value* result(const std::string& name) const {
        for (size_t i = 0; i < names_.size(); ++i)
            if (names_[i] == name) return results_[i].GetTensorData<Value>();
        throw std::logic_error(name + " was not asked for");
    }

    int64_t contacts() const {
        for (size_t i = 0; i < names_.size(); ++i)
            if (names_[i] == std::string("contact_points")) return results_[i].GetTensorTypeAndShapeInfo().GetShape().at(1);
        return 0;
    }

    std::string known(const char* key) {
        const auto value = known_.LookupCustomMetadataMapAllocated(key, allocator_);
        return value ? value.get() : "";
    }

    // The text of a status: the entry `"CODE": "TEXT"` of the JSON in `status_texts`, which holds no escapes.
    std::string status_text(int32_t code) {
        const std::string texts = known("status_texts"), key = '"' + std::to_string(code) + "\": \"";
        const size_t found = texts.find(key), begin = found + key.size();
        if (found == std::string::npos) return "no text in the model";
        return texts.substr(begin, texts.find('"', begin) - begin);
    }

  private:
    static Ort::SessionOptions one_thread() {
        Ort::SessionOptions options;
        options.SetIntraOpNumThreads(1);
        return options;
    }

    Ort::Env environment_{ORT_LOGGING_LEVEL_ERROR};
    Ort::Session session_;
    Ort::ModelMetadata known_;
    Ort::AllocatorWithDefaultOptions allocator_;
    std::vector<int64_t> size_;
    std::vector<Ort::Value> results_;
    const std::vector<const char*> names_{"status",         "wrench",        "pressure",       "pressure_change",
                                          "contact_points", "contact_force", "contact_normal", "contact_area",
                                          "contact_at_rim"};
};

void print(const char* what, const float* xyz, const std::string& unit) {
    std::printf("%s %.6g %.6g %.6g%s", what, xyz[0], xyz[1], xyz[2], unit.c_str());
}

bool say(Model& model) {
    const int32_t status = *model.result<int32_t>("status");
    std::printf("status: %d, %s\n", status, model.status_text(status).c_str());
    const float* wrench = model.result("wrench");
    if (std::isnan(wrench[0])) return false;
    const std::string length = model.known("length_unit"), force = model.known("force_unit");
    print("wrench: force", wrench, " " + force);
    print(", moment", wrench + 3, " " + force + " " + length + "\n");
    std::printf("pressure: %.6g %s/%s^2, change since rest %.6g\n", *model.result("pressure"), force.c_str(), length.c_str(),
                *model.result("pressure_change"));
    for (int64_t i = 0; i < model.contacts(); ++i) {
        const float* point = model.result("contact_points") + 3 * i;
        if (std::isnan(point[0])) break;
        std::printf("contact %d:", static_cast<int>(i + 1));
        print(" at", point, " " + length);
        print(", force", model.result("contact_force") + 3 * i, " " + force);
        print(", normal", model.result("contact_normal") + 3 * i, "");
        std::printf(", area %.6g %s^2%s\n", model.result("contact_area")[i], length.c_str(),
                    model.result("contact_at_rim")[i] > 0.5f ? ", reaches the rim: its force is a lower bound" : "");
    }
    return true;
}

int main(int count, char** arguments) {
    if (count != 3) {
        std::fprintf(stderr, "usage: frame MODEL.onnx IMAGE.pgm\n");
        return 2;
    }
    try {
        Model model(arguments[1]);
        Image image = read_pgm(arguments[2]);
        model.run(image);
        return say(model) ? 0 : 1;
    } catch (const std::exception& error) {
        std::fprintf(stderr, "frame: error: %s\n", error.what());
        return 2;
    }
}
